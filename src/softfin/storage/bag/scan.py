"""All that can be read of an MCAP file that was cut off or damaged, and where it is damaged."""

import io
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

from mcap.opcode import Opcode
from mcap.records import Footer

from softfin.core.errors import LogError
from softfin.storage.bag.records import HEAD, LARGEST_BYTES, MAGIC, RawRecord, Record, decode, read_records

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
        with path.open("rb") as file:
            yield from _scan(file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); give the path of a .mcap file") from None


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is whole."""
    damage = next((item for item in scan(path) if isinstance(item, Damage)), None)
    if damage is not None:
        raise LogError(
            f"{path}: truncated, or not a ROS 2 bag (at byte {damage.start:,}: {damage.reason}); "
            f"what it holds is saved by: softfin bag recover {path}"
        )


def _scan(file: io.BufferedIOBase, size: int) -> Iterator[Item]:
    if file.read(len(MAGIC)) != MAGIC:
        yield Damage(0, size, "it does not begin as MCAP")
        return
    at, reason = len(MAGIC), "a record that is not whole"
    try:
        for record in read_records(file, at, size):
            at = record.end
            if record.opcode == Opcode.FOOTER:
                if not _is_end(file, record, size):
                    yield Damage(record.start, size - record.start, "the index or the end is damaged")
                return
            yield from _decode(record)
    except LogError as error:
        reason = str(error)
    saved = 0
    for record in _records_of_cut_chunk(file, at, size):
        yield from _decode(record)
        saved += record.end - record.start
    yield Damage(at, size - at - saved, reason if at < size else "it has no end")


def _decode(record: RawRecord) -> list[Item]:
    try:
        return [*decode(record)]
    except LogError as error:
        return [Damage(record.start, record.end - record.start, str(error))]


def _records_of_cut_chunk(file: io.BufferedIOBase, at: int, size: int) -> Iterator[RawRecord]:
    """Yield the whole records of a last chunk that was not compressed."""
    file.seek(at)
    head = file.read(HEAD.size + CHUNK_HEAD_BYTES)
    if len(head) == HEAD.size + CHUNK_HEAD_BYTES and head[0] == Opcode.CHUNK and head[37:41] == bytes(4):
        # A file system shows zeros where bytes never reached the disk, so no message may end in them.
        beginning = file.read(min(size - at, LARGEST_BYTES)).rstrip(b"\0")
        try:
            yield from read_records(io.BytesIO(beginning), 0, len(beginning))
        except LogError:
            # Behind the first bytes that are not a record there is nothing to save.
            return


def _is_end(file: io.BufferedIOBase, record: RawRecord, size: int) -> bool:
    """Whether a footer is followed by the file's last bytes, and the checksum of the index before it is right."""
    (footer,) = decode(record)
    file.seek(record.end)
    if file.read() != MAGIC or not isinstance(footer, Footer) or footer.summary_start > record.start:
        return False
    if not footer.summary_start or not footer.summary_crc:
        return True
    file.seek(footer.summary_start)
    index = file.read(record.start - footer.summary_start + HEAD.size + 16)
    return zlib.crc32(index) == footer.summary_crc
