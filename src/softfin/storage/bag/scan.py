"""An MCAP file read piece by piece without belief in it: lengths are held against the file, chunks against their sums.

Behind a damage the next chunk whose checksum is right is looked for. Memory is bounded by `LARGEST`, and the work by
`check_cost`, which counts the bytes that are on the disk: holes of a sparse file are skipped and allow nothing.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from softfin.core.errors import LogError
from softfin.core.files import regular_file
from softfin.storage.bag.chunks import (
    CHANNEL,
    CHUNK,
    FOOTER,
    LARGEST,
    MAGIC,
    MESSAGE,
    RECORD_HEAD,
    SCHEMA,
    WINDOW,
    UnreadableChunk,
    bytes_held,
    check_cost,
    data_from,
    inflated,
    promised,
    records,
)

LOOSE = 2**16
"""Bytes in which records that are in no chunk are read together."""

COUNTED = 2**16
"""Records of one piece between two looks at their number."""

CANDIDATE = re.compile(rb"\x06(?=.{5}\0\0\0.{28}(?:\0{4}|\x03\0\0\0lz4|\x04\0\0\0zstd))", re.DOTALL)
"""How a chunk begins that is shorter than a terabyte."""

_LONGEST_HEAD = 64
"""More than a chunk's fields before its records."""


class Damage(NamedTuple):
    """A stretch of the file that cannot be read."""

    start: int
    length: int
    reason: str


class BagScan:
    """One walk through a file: `records`, and after them what was wrong."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damages: list[Damage] = []
        self.ended = False
        """Whether the file has its end, with an index whose checksum is right."""
        self._held = self._bytes = self._count = self._tried = 0
        self._window = (-WINDOW, b"")
        """Where the search for chunks has last read, and what."""

    def records(self) -> Iterator[tuple[int, memoryview]]:
        """Opcode and content of each record, in chunks or not; 0 and the rest where a chunk ends within a record."""
        try:
            with regular_file(self.path).open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                self._held = bytes_held(file, size)
                for piece in self._walk(file, size):
                    count = 0
                    for count, record in enumerate(records(piece), 1):
                        if not count % COUNTED:
                            self._charge(0, COUNTED)
                        yield record
                    self._charge(0, count % COUNTED)
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read ({error.strerror}); give the path of a .mcap file") from None

    def _charge(self, inflated_bytes: int, count: int) -> None:
        self._bytes, self._count = self._bytes + inflated_bytes, self._count + count
        try:
            check_cost(self._held, self._bytes, self._count)
        except LogError as error:
            raise LogError(f"{self.path}: {error}") from None

    def _walk(self, file: BinaryIO, size: int) -> Iterator[bytes]:
        """Records that follow one another, of the file itself or of a chunk."""
        at = sound = len(MAGIC)
        if file.read(at) != MAGIC:
            at = sound = self._next(file, 0, size)
            self.damages.append(Damage(0, at, "it does not begin as MCAP"))
            if at == size:
                return
        while at < size and not self.ended:
            opcode, length = _head(file, at, size)
            end = at + 9 + length
            piece, reason = b"", "a record that is none"
            self._charge(0, 1)
            if opcode == FOOTER:
                self.ended = _is_end(file, at, size, self._held)
                if not self.ended:
                    self.damages.append(Damage(at, size - at, "the index or the end is damaged"))
                return
            if opcode and end <= size:
                piece, reason = self._piece(file, opcode, at, length)
                end = max(end, at + len(piece)) if opcode != CHUNK else end
            elif opcode == CHUNK:
                reason = "a chunk without its end"
            if reason:
                # A chunk whose length is that of its fields was damaged within: what follows it is in its place.
                trusted = opcode == CHUNK and end <= size and _chunk_fits(file, at, length)
                # Else a length before it may have been wrong too: the search begins where all was right.
                following = end if trusted else self._next(file, sound, size)
                if following == size and opcode == CHUNK and end > size:
                    piece = _cut(file, at, size)
                lost = max(0, following - at) - len(piece)
                self.damages.append(Damage(at, lost, reason))
                end = following
            if piece:
                yield piece
            if opcode == CHUNK or reason:
                sound = end
            at = end
        if not self.ended:
            self.damages.append(Damage(size, 0, "it has no end"))

    def _piece(self, file: BinaryIO, opcode: int, at: int, length: int) -> tuple[bytes, str]:
        """The records of a chunk, or those that begin here and are in none; or why it holds nothing."""
        if opcode == CHUNK:
            if length > LARGEST:
                return b"", _too_large(length)
            try:
                return self._inflated(_read(file, at + 9, length)), ""
            except UnreadableChunk as error:
                return b"", str(error)
        if opcode in (SCHEMA, CHANNEL, MESSAGE):
            if length > LARGEST:
                return b"", _too_large(length)
        elif 9 + length > LOOSE:
            return b"", ""
        window = _read(file, at, max(LOOSE, 9 + length))
        whole = 0
        for following, content in records(window):
            if following in (0, CHUNK, FOOTER):
                break
            whole += 9 + len(content)
        return window[:whole], ""

    def _next(self, file: BinaryIO, at: int, size: int) -> int:
        """Where the next chunk begins whose checksum is right; the file's size if none does."""
        while (at := data_from(file, at, size)) < size:
            begin, window = self._window
            if not begin <= at < begin + WINDOW:
                begin, window = self._window = at, _read(file, at, WINDOW + _LONGEST_HEAD)
            for found in CANDIDATE.finditer(window, at - begin):
                start = begin + found.start()
                if start >= begin + WINDOW or self._tried > 4 * self._held + LARGEST:
                    break
                if self._is_sound(file, start, size):
                    return start
            at = begin + WINDOW
        return size

    def _is_sound(self, file: BinaryIO, at: int, size: int) -> bool:
        _, length = _head(file, at, size)
        if at + 9 + length > size or length > LARGEST or not _chunk_fits(file, at, length):
            return False
        # A file made for it could let every byte begin a chunk; the search costs a few readings of the file at most.
        self._tried += length
        content = _read(file, at + 9, length)
        try:
            return struct.unpack_from("<I", content, 24)[0] != 0 and bool(self._inflated(content))
        except UnreadableChunk:
            return False

    def _inflated(self, chunk: bytes) -> bytes:
        # What comes to nothing costs as much.
        self._charge(promised(chunk), 0)
        return inflated(chunk)


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is whole, before anything that believes in its lengths reads it."""
    scan = BagScan(path)
    for _ in scan.records():
        pass
    if scan.damages:
        first = scan.damages[0]
        raise LogError(
            f"{path}: truncated, or no ROS 2 bag (at byte {first.start:,}: {first.reason}); "
            f"what it holds is saved by: softfin bag recover {path}"
        )


def _too_large(length: int) -> str:
    return f"a record of {length / 1e6:,.0f} MB, allowed are {LARGEST / 1e6:,.0f}"


def _read(file: BinaryIO, at: int, length: int) -> bytes:
    file.seek(at)
    return file.read(length)


def _head(file: BinaryIO, at: int, size: int) -> tuple[int, int]:
    head = _read(file, at, 9)
    return RECORD_HEAD.unpack(head) if len(head) == 9 else (0, size)


def _is_end(file: BinaryIO, at: int, size: int, held: int) -> bool:
    """A footer, an index as it says, the file's last bytes."""
    tail = _read(file, at, 37 + 1)
    if len(tail) != 37 or tail[29:] != MAGIC or at + 37 != size:
        return False
    length, start, _, expected = struct.unpack_from("<QQQI", tail, 1)
    # Behind its hole, a sparse file would be summed for minutes.
    if length != 20 or start > at or (start and at - start > held):
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


def _cut(file: BinaryIO, at: int, size: int) -> bytes:
    """The whole records at the beginning of the last chunk, where it was not compressed.

    Zeros at the end are what a file system shows where bytes never reached the disk, so no message may end in them.
    """
    content = _read(file, at + 9, min(size - at - 9, LARGEST))
    if len(content) < 40 or content[28:32] != b"\0\0\0\0":
        return b""
    beginning = content[40:].rstrip(b"\0")
    return beginning[: sum(9 + len(record) for opcode, record in records(beginning) if opcode)]
