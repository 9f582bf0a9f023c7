"""Chunks and records of MCAP: bytes in, records out, and a bound on what a file may cost whoever reads it.

No length is believed before it is held against the bytes that are there. Layout: the MCAP specification, version 0.
"""

import errno
import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from softfin.core.errors import LogError

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(1, 7)
"""Opcodes."""

LARGEST = 64 * 2**20
"""Bytes of the largest record, or chunk when inflated, that is read; ROS 2 closes its chunks below one megabyte."""

GROWTH = 200
"""What a file may inflate to, as a multiple of itself: a recording's numbers do not reach a tenth of it."""

RECORD_BYTES = 4
"""What a record takes of a compressed file at least, on the mean; of a constant signal it takes seven."""

RECORDS = 2**20
"""That a file of any size may hold."""

WINDOW = 2**20

_ZSTD = (b"\x28\xb5\x2f\xfd", *(bytes((first, 0x2A, 0x4D, 0x18)) for first in range(0x50, 0x60)))
"""How zstd's frames begin."""

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length."""


class UnreadableChunk(LogError):
    """A chunk whose records cannot be had."""


def records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of each; at last 0 and what is left, if that is no whole record."""
    view, at, size, head = memoryview(data), 0, len(data), RECORD_HEAD.unpack_from
    while at + 9 <= size:
        opcode, length = head(view, at)
        end = at + 9 + length
        if not opcode or end > size:
            break
        yield opcode, view[at + 9 : end]
        at = end
    if at < size:
        yield 0, view[at:]


def promised(chunk: bytes) -> int:
    """Bytes that are inflated at most where a chunk is read, whatever comes of it."""
    return min(struct.unpack_from("<Q", chunk, 16)[0], LARGEST) if len(chunk) >= 24 else 0


def inflated(chunk: bytes) -> bytes:
    """The records of a chunk, as bytes that are as many as it says and whose checksum is right."""
    try:
        expected, checksum, name = struct.unpack_from("<QII", chunk, 16)
        length = struct.unpack_from("<Q", chunk, 32 + name)[0]
    except struct.error:
        raise UnreadableChunk("a chunk without its fields") from None
    data = chunk[40 + name :]
    if len(data) != length or expected > LARGEST:
        raise UnreadableChunk("a chunk of another length than it says")
    try:
        whole = _inflated(data, chunk[32 : 32 + name], expected)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise UnreadableChunk(f"a chunk that does not inflate: {' '.join(str(error).split())}") from None
    if len(whole) != expected:
        raise UnreadableChunk("a chunk that inflates to another length than it says")
    if checksum and zlib.crc32(whole) != checksum:
        raise UnreadableChunk("a chunk whose checksum is wrong")
    return whole


def _inflated(data: bytes, compression: bytes, expected: int) -> bytes:
    """One byte more than expected at most: enough to tell that it is wrong."""
    if not compression:
        return data
    if compression == b"lz4":
        found: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=expected + 1)
        return found
    if compression != b"zstd":
        raise UnreadableChunk("a chunk of unknown compression")
    return inflated_zstd(data, expected)


def inflated_zstd(data: bytes, most: int) -> bytes:
    """What zstd has packed; more than `most` bytes, and not all of them, where it is more."""
    whole = bytearray()
    with zstandard.ZstdDecompressor(max_window_size=LARGEST).stream_reader(data) as stream:
        while len(whole) <= most and (some := stream.read(WINDOW)):
            whole += some
    return bytes(whole)


def check_inflated_size(file: BinaryIO, held: int) -> None:
    """Raise LogError where a file that is compressed as a whole inflates to more than any recording."""
    if file.read(4) not in _ZSTD:
        return
    file.seek(0)
    decompressor, length = zstandard.ZstdDecompressor(max_window_size=LARGEST), 0
    with decompressor.stream_reader(file, read_across_frames=True, closefd=False) as stream:
        while some := stream.read(WINDOW):
            length += len(some)
            check_cost(held, length, 0)


def check_cost(held: int, length: int, count: int) -> None:
    """Raise LogError where a file that holds so many bytes has come to too many inflated bytes, or records."""
    if length > GROWTH * held + LARGEST:
        raise LogError(f"inflates to more than {GROWTH} times its size: it is no recording")
    if count > held // RECORD_BYTES + RECORDS:
        raise LogError(f"has over {count:,} records in {held:,} bytes: it is no recording")


def data_from(file: BinaryIO, at: int, size: int) -> int:
    """Where bytes that are on the disk begin again, at `at` or behind a hole of a sparse file; `size` if nowhere."""
    return _sought(file, at, getattr(os, "SEEK_DATA", None), at, size)


def bytes_held(file: BinaryIO, size: int) -> int:
    """How many bytes of a file are on the disk: a sparse file may be said to be any size."""
    held = at = 0
    while (start := data_from(file, at, size)) < size:
        at = _sought(file, start, getattr(os, "SEEK_HOLE", None), size, size)
        held += at - start
    return held


def _sought(file: BinaryIO, at: int, whence: int | None, otherwise: int, size: int) -> int:
    """Where the file system says; `otherwise` where it knows of no holes."""
    if whence is None:
        return otherwise
    descriptor = file.fileno()
    before = os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        return min(os.lseek(descriptor, at, whence), size)
    except OSError as error:
        return size if error.errno == errno.ENXIO else otherwise
    finally:
        # The buffer of the file counts on it.
        os.lseek(descriptor, before, os.SEEK_SET)
