"""All that can be read of an MCAP file that was cut off or damaged, and where it is damaged.

Behind damage that makes lengths doubtful, reading goes on at the next chunk whose checksum is right.
"""

import io
import mmap
import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

from mcap.opcode import Opcode
from mcap.records import Footer

from softfin.core.errors import LogError
from softfin.core.files import regular_file
from softfin.storage.bag.records import (
    HEAD,
    LARGEST_BYTES,
    MAGIC,
    RawRecord,
    Record,
    decode,
    is_chunk_length_right,
    read_records,
)

CHUNK_START = re.compile(rb"\x06(?=.{5}\0\0\0.{28}(?:\0{4}|\x03\0\0\0lz4|\x04\0\0\0zstd))", re.DOTALL)
"""First bytes of a chunk that is shorter than a terabyte."""

CHUNK_HEAD_BYTES = 40
"""Fields of an uncompressed chunk before its records."""


class Damage(NamedTuple):
    """A part of the file that cannot be read."""

    start: int
    length: int
    reason: str


Item: TypeAlias = Record | Damage


def scan(path: Path) -> Iterator[Item]:
    """Yield the records of a file in order, those in chunks too, and each damage where it is met."""
    try:
        with regular_file(path).open("rb") as file:
            yield from _scan(file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); give the path of a .mcap file") from None


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is whole."""
    damage = next((item for item in scan(path) if isinstance(item, Damage)), None)
    if damage is not None:
        raise LogError(
            f"{path}: truncated, or no ROS 2 bag (at byte {damage.start:,}: {damage.reason}); "
            f"what it holds is saved by: softfin bag recover {path}"
        )


def _scan(file: io.BufferedIOBase, size: int) -> Iterator[Item]:
    at = trusted = len(MAGIC)
    if file.read(at) != MAGIC:
        at = trusted = _next_chunk(file, 0, size)
        yield Damage(0, at, "it does not begin as MCAP")
    while at < size:
        reason = "a record that is not whole"
        try:
            for record in read_records(file, at, size):
                if record.opcode == Opcode.FOOTER:
                    if not _is_end(file, record, size):
                        yield Damage(record.start, size - record.start, "the index or the end is damaged")
                    return
                try:
                    items = decode(record)
                except LogError as error:
                    if record.opcode == Opcode.CHUNK and not is_chunk_length_right(record.content):
                        raise
                    yield Damage(record.start, record.end - record.start, str(error))
                else:
                    yield from items
                    trusted = record.end if items else trusted
                at = record.end
        except LogError as error:
            reason = str(error)
        if at < size:
            following, saved = _next_chunk(file, trusted, size), 0
            if following == size:
                for record in _records_of_cut_chunk(file, at, size):
                    yield from decode(record)
                    saved += record.end - record.start
            yield Damage(at, max(0, following - at - saved), reason)
            at = trusted = following
    yield Damage(size, 0, "it has no end")


def _records_of_cut_chunk(file: io.BufferedIOBase, at: int, size: int) -> Iterator[RawRecord]:
    """Yield the whole records of a last chunk that was not compressed."""
    file.seek(at)
    head = file.read(HEAD.size + CHUNK_HEAD_BYTES)
    if len(head) == HEAD.size + CHUNK_HEAD_BYTES and head[0] == Opcode.CHUNK and head[37:41] == bytes(4):
        # A file system shows zeros where bytes never reached the disk, so no message may end in them.
        beginning = file.read(min(size - at, LARGEST_BYTES)).rstrip(b"\0")
        yield from read_records(io.BytesIO(beginning), 0, len(beginning))


def _next_chunk(file: io.BufferedIOBase, start: int, size: int) -> int:
    """Find the first byte of the next chunk whose checksum is right; the file's size if there is none."""
    if start >= size:
        return size
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in CHUNK_START.finditer(data, start):
            at = found.start()
            _, length = HEAD.unpack_from(data, at)
            if at + HEAD.size + length > size or length > LARGEST_BYTES:
                continue
            content = data[at + HEAD.size : at + HEAD.size + length]
            # Without a checksum, anything could be taken for a chunk.
            if is_chunk_length_right(content) and struct.unpack_from("<I", content, 24)[0]:
                try:
                    decode(RawRecord(Opcode.CHUNK, at, at + HEAD.size + length, content))
                except LogError:
                    continue
                return at
    return size


def _is_end(file: io.BufferedIOBase, record: RawRecord, size: int) -> bool:
    """Whether a footer is followed by the file's last bytes, and the checksum of the index before it is right."""
    if len(record.content) != 20 or record.end + len(MAGIC) != size:
        return False
    (footer,) = decode(record)
    file.seek(record.end)
    if file.read() != MAGIC or not isinstance(footer, Footer) or footer.summary_start > record.start:
        return False
    if not footer.summary_start or not footer.summary_crc:
        return True
    file.seek(footer.summary_start)
    index = file.read(record.start - footer.summary_start + HEAD.size + 16)
    return bool(zlib.crc32(index) == footer.summary_crc)
