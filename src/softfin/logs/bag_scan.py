"""An MCAP file read piece by piece without belief in it: lengths are held against the file, chunks against their sums.

Behind a damage the next chunk whose checksum is right is looked for. Memory is bounded by `LARGEST`, and what the file
inflates to by `GROWTH`. Layout of records: the MCAP specification, version 0.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from softfin.errors import LogError

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(1, 7)
"""Opcodes."""

LARGEST = 64 * 2**20
"""Bytes of the largest record, or chunk when inflated, that is read; ROS 2 closes its chunks below one megabyte."""

GROWTH = 200
"""What a file may inflate to, as a multiple of itself: a recording's numbers do not reach a tenth of it."""

CANDIDATE = re.compile(rb"\x06(?=.{5}\0\0\0.{28}(?:\0{4}|\x03\0\0\0lz4|\x04\0\0\0zstd))", re.DOTALL)
"""How a chunk begins that is shorter than a terabyte."""

WINDOW = 2**20

_LONGEST_HEAD = 64
"""More than a chunk's fields before its records."""


class Piece(NamedTuple):
    """Records that follow one another."""

    data: bytes


class Damage(NamedTuple):
    """A stretch of the file that cannot be read."""

    start: int
    length: int
    reason: str


class _Unreadable(Exception):
    """Of a chunk."""


class BagScan:
    """One walk through a file: `pieces`, and after them what was wrong."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damages: list[Damage] = []
        self.ended = False
        """Whether the file has its end, with an index whose checksum is right."""

    def pieces(self) -> Iterator[Piece]:
        """Of the chunks, and of the records outside of them that define or hold messages."""
        try:
            with self.path.open("rb") as file:
                yield from self._walk(file, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read ({error.strerror}); give the path of a .mcap file") from None

    def _walk(self, file: BinaryIO, size: int) -> Iterator[Piece]:
        inflated, self._tried = 0, 0
        at = sound = len(MAGIC)
        if file.read(at) != MAGIC:
            at = sound = self._next(file, 0, size)
            self.damages.append(Damage(0, at, "it does not begin as MCAP"))
            if at == size:
                return
        while at < size and not self.ended:
            opcode, length = _head(file, at, size)
            end = at + 9 + length
            piece, reason = None, "a record that is none"
            if opcode == FOOTER:
                self.ended = _is_end(file, at, size)
                if not self.ended:
                    self.damages.append(Damage(at, size - at, "the index or the end is damaged"))
                return
            if opcode and end <= size:
                piece, reason = self._piece(file, opcode, at, length)
            elif opcode == CHUNK:
                reason = "a chunk without its end"
            if reason:
                # A chunk whose length is that of its fields was damaged within: what follows it is in its place.
                trusted = opcode == CHUNK and end <= size and _chunk_fits(file, at, length)
                # Else a length before it may have been wrong too: the search begins where all was right.
                following = end if trusted else self._next(file, sound, size)
                if following == size and opcode == CHUNK and end > size:
                    piece = _cut(file, at, size)
                lost = max(0, following - at) - (len(piece.data) if piece else 0)
                self.damages.append(Damage(at, lost, reason))
                end = following
            if piece is not None:
                inflated += len(piece.data)
                if inflated > GROWTH * size + LARGEST:
                    raise LogError(f"{self.path}: inflates to more than {GROWTH} times its size: it is no recording")
                yield piece
            if opcode == CHUNK or reason:
                sound = end
            at = end
        if not self.ended:
            self.damages.append(Damage(size, 0, "it has no end"))

    def _piece(self, file: BinaryIO, opcode: int, at: int, length: int) -> tuple[Piece | None, str]:
        """What a whole record holds, or why it holds nothing."""
        if opcode not in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
            return None, ""
        if length > LARGEST:
            return None, f"a record of {length / 1e6:,.0f} MB, allowed are {LARGEST / 1e6:,.0f}"
        if opcode != CHUNK:
            return Piece(_read(file, at, 9 + length)), ""
        try:
            return Piece(_records(_read(file, at + 9, length))), ""
        except _Unreadable as error:
            return None, str(error)

    def _next(self, file: BinaryIO, at: int, size: int) -> int:
        """Where the next chunk begins whose checksum is right; the file's size if none does."""
        while at < size:
            window = _read(file, at, WINDOW + _LONGEST_HEAD)
            for found in CANDIDATE.finditer(window):
                start = at + found.start()
                if start >= at + WINDOW or self._tried > 4 * size + LARGEST:
                    break
                if self._is_sound(file, start, size):
                    return start
            at += WINDOW
        return size

    def _is_sound(self, file: BinaryIO, at: int, size: int) -> bool:
        _, length = _head(file, at, size)
        if at + 9 + length > size or length > LARGEST or not _chunk_fits(file, at, length):
            return False
        # A file made for it could let every byte begin a chunk; the search costs a few readings of the file at most.
        self._tried += length
        content = _read(file, at + 9, length)
        try:
            return struct.unpack_from("<I", content, 24)[0] != 0 and bool(_records(content))
        except _Unreadable:
            return False


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is whole, before anything that believes in its lengths reads it."""
    scan = BagScan(path)
    for _ in scan.pieces():
        pass
    if scan.damages:
        first = scan.damages[0]
        raise LogError(
            f"{path}: truncated, or no ROS 2 bag (at byte {first.start:,}: {first.reason}); "
            f"what it holds is saved by: softfin bag recover {path}"
        )


def records(piece: Piece) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of each; at last 0 and what is left, if that is no whole record."""
    view, at = memoryview(piece.data), 0
    while at + 9 <= len(view):
        opcode, length = struct.unpack_from("<BQ", view, at)
        if not opcode or at + 9 + length > len(view):
            break
        yield opcode, view[at + 9 : at + 9 + length]
        at += 9 + length
    if at < len(view):
        yield 0, view[at:]


def _read(file: BinaryIO, at: int, length: int) -> bytes:
    file.seek(at)
    return file.read(length)


def _head(file: BinaryIO, at: int, size: int) -> tuple[int, int]:
    head = _read(file, at, 9)
    return struct.unpack("<BQ", head) if len(head) == 9 else (0, size)


def _is_end(file: BinaryIO, at: int, size: int) -> bool:
    """A footer, an index as it says, the file's last bytes."""
    tail = _read(file, at, 37 + 1)
    if len(tail) != 37 or tail[29:] != MAGIC or at + 37 != size:
        return False
    length, start, _, expected = struct.unpack_from("<QQQI", tail, 1)
    if length != 20 or start > at:
        return False
    if not start or not expected:
        return True
    found = 0
    for offset in range(start, at, WINDOW):
        found = zlib.crc32(_read(file, offset, min(WINDOW, at - offset)), found)
    return bool(zlib.crc32(tail[: 1 + 8 + 16], found) == expected)


def _chunk_fits(file: BinaryIO, at: int, length: int) -> bool:
    """Whether a chunk's length is what its own fields add up to."""
    fields = _read(file, at + 9, min(length, _LONGEST_HEAD))
    try:
        name = struct.unpack_from("<I", fields, 28)[0]
        return name <= 4 and bool(length == 40 + name + struct.unpack_from("<Q", fields, 32 + name)[0])
    except struct.error:
        return False


def _records(content: bytes) -> bytes:
    """Of a chunk, inflated and checked; raises _Unreadable."""
    try:
        expected, checksum, name = struct.unpack_from("<QII", content, 16)
        compression = content[32 : 32 + name]
        length = struct.unpack_from("<Q", content, 32 + name)[0]
    except struct.error:
        raise _Unreadable("a chunk without its fields") from None
    data = content[40 + name :]
    if len(data) != length or expected > LARGEST:
        raise _Unreadable("a chunk of another length than it says")
    try:
        whole = _inflated(data, compression, expected)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise _Unreadable(f"a chunk that does not inflate: {' '.join(str(error).split())}") from None
    if len(whole) != expected:
        raise _Unreadable("a chunk that inflates to another length than it says")
    if checksum and zlib.crc32(whole) != checksum:
        raise _Unreadable("a chunk whose checksum is wrong")
    return whole


def _inflated(data: bytes, compression: bytes, expected: int) -> bytes:
    """One byte more than expected at most: enough to tell that it is wrong."""
    if not compression:
        return data
    if compression == b"lz4":
        found: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=expected + 1)
        return found
    if compression != b"zstd":
        raise _Unreadable("a chunk of unknown compression")
    whole = bytearray()
    with zstandard.ZstdDecompressor(max_window_size=LARGEST).stream_reader(data) as stream:
        while len(whole) <= expected and (some := stream.read(WINDOW)):
            whole += some
    return bytes(whole)


def _cut(file: BinaryIO, at: int, size: int) -> Piece | None:
    """The whole records at the beginning of the last chunk, where it was not compressed.

    Zeros at the end are what a file system shows where bytes never reached the disk, so no message may end in them.
    """
    content = _read(file, at + 9, min(size - at - 9, LARGEST))
    if len(content) < 40 or content[28:32] != b"\0\0\0\0":
        return None
    beginning = Piece(content[40:].rstrip(b"\0"))
    whole = sum(9 + len(record) for opcode, record in records(beginning) if opcode)
    return Piece(beginning.data[:whole]) if whole else None
