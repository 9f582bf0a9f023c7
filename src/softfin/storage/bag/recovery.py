"""Reads bags that are complete, still growing, truncated or damaged. Converts bytes to the mcap
library's records or to a complete bag.

The library's own readers need a properly closed file. Here, a record is read as soon as it is
complete in the file, and a chunk only if its length and checksum are correct.
"""

import contextlib
import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias, cast

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import breakup_chunk

from softfin.core.errors import LogError, one_line
from softfin.core.json_object import JsonObject
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import start_writer
from softfin.storage.formats import check_file_format

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""

HEAD = struct.Struct("<BQ")
"""Header of each record: opcode and length."""

MAX_RECORD_BYTES = 64 * 2**20
"""Size of the largest record or unpacked chunk that is read [bytes]. ROS 2 closes its chunks below
one megabyte."""

BagRecord: TypeAlias = Schema | Channel | Message | Footer

_KINDS: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.FOOTER: Footer}


class RawRecord(NamedTuple):
    """A record before it is decoded."""

    opcode: int
    start: int
    end: int
    """Offsets of the record's first byte and of the byte after it."""
    content: bytes
    """Bytes after the header; empty for an attachment."""


class Damage(NamedTuple):
    """A part of the file that cannot be read."""

    start: int
    length: int
    reason: str


def read_records(file: io.BufferedIOBase, start: int, size: int) -> Iterator[RawRecord]:
    """Yield the complete records between two offsets of a file; raises LogError at bytes that
    cannot be a record."""
    while start + HEAD.size <= size:
        file.seek(start)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size or not any(head):
            # On a network share, or after a power cut, a file can have its final length but not yet
            # its bytes.
            return
        opcode, length = HEAD.unpack(head)
        if not opcode or (opcode != Opcode.ATTACHMENT and length > MAX_RECORD_BYTES):
            raise LogError(
                f"invalid record of kind {opcode} with {length:,} bytes at byte {start:,}"
            )
        end = start + HEAD.size + length
        if end > size:
            return
        yield RawRecord(
            opcode, start, end, b"" if opcode == Opcode.ATTACHMENT else file.read(length)
        )
        start = end


def decode_bag_record(record: RawRecord) -> list[BagRecord]:
    """Decode a record, or all records of a chunk; raises LogError if it is damaged."""
    stream = ReadDataStream(io.BytesIO(record.content))
    try:
        if record.opcode == Opcode.MESSAGE:
            return [Message.read(stream, len(record.content))]
        if record.opcode != Opcode.CHUNK:
            return [_KINDS[record.opcode].read(stream)] if record.opcode in _KINDS else []
        chunk = Chunk.read(stream)
        if chunk.uncompressed_size > MAX_RECORD_BYTES:
            raise ValueError(
                f"{chunk.uncompressed_size:,} bytes unpacked, limit {MAX_RECORD_BYTES:,}"
            )
        return cast(list[BagRecord], breakup_chunk(chunk, validate_crc=True))
    except (
        McapError,
        zstandard.ZstdError,
        ValueError,
        OverflowError,
        RuntimeError,
        EOFError,
        struct.error,
    ) as error:
        what = "chunk" if record.opcode == Opcode.CHUNK else "record"
        raise LogError(f"{what} cannot be decoded ({one_line(error)})") from None


def scan(path: Path) -> Iterator[BagRecord | Damage]:
    """Yield the records of a file in order, including those in chunks, and damaged parts where they
    occur."""
    try:
        with path.open("rb") as file:
            yield from _scan(file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read ({error.strerror}); use the path of a .mcap file"
        ) from None


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is complete and in a format that this version reads."""
    for item in scan(path):
        if isinstance(item, Channel):
            check_file_format("recording", item.metadata, str(path))
        elif isinstance(item, Damage):
            raise LogError(
                f"{path}: truncated, or not a ROS 2 bag (at byte {item.start:,}: {item.reason}); "
                f"to save its readable contents, run softfin bag recover {path}"
            )


def _scan(file: io.BufferedIOBase, size: int) -> Iterator[BagRecord | Damage]:
    if file.read(len(MAGIC)) != MAGIC:
        yield Damage(0, size, "it does not start with the MCAP signature")
        return
    at = len(MAGIC)
    reason = "incomplete record"
    try:
        for record in read_records(file, at, size):
            at = record.end
            if record.opcode == Opcode.FOOTER:
                if not _is_end(file, record):
                    yield Damage(
                        record.start, size - record.start, "the index or the footer is damaged"
                    )
                return
            yield from _decode(record)
    except LogError as error:
        reason = str(error)
    saved = 0
    for record in _records_of_cut_chunk(file, at, size):
        yield from _decode(record)
        saved += record.end - record.start
    yield Damage(at, size - at - saved, reason if at < size else "the footer is missing")


def _decode(record: RawRecord) -> list[BagRecord] | list[Damage]:
    try:
        return decode_bag_record(record)
    except LogError as error:
        return [Damage(record.start, record.end - record.start, str(error))]


def _records_of_cut_chunk(file: io.BufferedIOBase, at: int, size: int) -> Iterator[RawRecord]:
    """Yield the complete records of a final, uncompressed chunk."""
    file.seek(at)
    # Opcode, length and the fields of an uncompressed chunk: the name of its compression is empty.
    head = file.read(49)
    if head[:1] == bytes([Opcode.CHUNK]) and head[37:41] == bytes(4):
        # File systems return zeros for bytes that never reached the disk, so a message must not
        # extend into them.
        beginning = file.read(min(size - at, MAX_RECORD_BYTES)).rstrip(b"\0")
        # After the first bytes that are not a record, nothing can be saved.
        with contextlib.suppress(LogError):
            yield from read_records(io.BytesIO(beginning), 0, len(beginning))


def _is_end(file: io.BufferedIOBase, record: RawRecord) -> bool:
    """Whether the closing bytes follow the footer, and the checksum of the index is correct."""
    file.seek(record.end)
    if file.read() != MAGIC or len(record.content) < 20:
        return False
    # Footer: start of the summary, start of the summary's offsets, CRC-32 of the summary.
    start, _, checksum = struct.unpack_from("<QQI", record.content)
    if start > record.start:
        return False
    # The checksum covers the index and the footer, except for the checksum itself.
    file.seek(start)
    # In MCAP, 0 means that there is no summary, or no checksum.
    return not (start and checksum) or zlib.crc32(file.read(record.end - 4 - start)) == checksum


class Recovery(NamedTuple):
    """Result of a recovery."""

    whole: bool
    """Whether the bag was complete; nothing is written in that case."""
    messages: dict[str, int]
    """Number of messages per topic: saved ones, or all of them if the bag was complete."""
    seconds: float
    """Time from the first to the last message [s]."""
    orphans: int
    """Number of messages whose topic is unknown because its definition was lost; these are not
    saved."""
    damages: tuple[Damage, ...]
    """Parts of the file that could not be read."""

    def to_dict(self) -> JsonObject:
        """Convert for JSON."""
        return self._asdict() | {
            "damages": [
                {"byte": at, "bytes": length, "reason": reason}
                for at, length, reason in self.damages
            ]
        }


def recovered_path(path: Path) -> Path:
    """Return the default output path: ``run.recovered.mcap`` next to ``run.mcap``."""
    return path.with_name(f"{path.stem}.recovered.mcap")


class _Contents:
    """Readable contents of a bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts = Counter[int]()
        """Number of messages by channel."""
        self.damages = list[Damage]()
        self._first = 2**64
        self._last = 0
        # If the first chunk is lost, definitions may follow their messages, because the index
        # repeats them.
        for item in scan(path):
            match item:
                case Damage():
                    self.damages.append(item)
                case Schema():
                    self.schemas.setdefault(item.id, item)
                case Channel():
                    self.channels.setdefault(item.id, item)
                case Message():
                    self.counts[item.channel_id] += 1
                    self._first = min(self._first, item.log_time)
                    self._last = max(self._last, item.log_time)

    @property
    def seconds(self) -> float:
        """Time from the first to the last message [s]."""
        return max(0, self._last - self._first) / 1e9

    def messages(self) -> Counter[str]:
        """Count the messages of known channels by topic."""
        messages = Counter[str]()
        for number in sorted(self.channels.keys() & self.counts):
            messages[self.channels[number].topic] += self.counts[number]
        return messages

    def copy(self, file: BinaryIO) -> None:
        """Write everything readable as a new bag."""
        writer = start_writer(file)
        # In MCAP, schema id 0 means "no schema".
        registered = {0: 0}
        written = {}
        for number, schema in self.schemas.items():
            registered[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, channel in self.channels.items():
            kind = registered.get(channel.schema_id, 0)
            written[number] = writer.register_channel(
                channel.topic, channel.message_encoding, kind, channel.metadata
            )
        for item in scan(self.path):
            if isinstance(item, Message) and item.channel_id in written:
                channel_id = written[item.channel_id]
                writer.add_message(
                    channel_id, item.log_time, item.data, item.publish_time, item.sequence
                )
        writer.finish()


def recover(path: Path, out: Path, overwrite: bool = False) -> Recovery:
    """Save all readable messages; raises LogError if there are none, and ArtifactError if `out`
    exists."""
    artifacts.check_file(out, overwrite and out.resolve() != path.resolve())
    contents = _Contents(path)
    messages = contents.messages()
    damages = contents.damages
    orphans = contents.counts.total() - messages.total()
    if orphans:
        damages.append(Damage(0, 0, f"{orphans:,} messages of unknown topics"))
    if damages and not messages:
        raise LogError(
            f"{path}: contains no readable messages ({damages[0].reason}); copy it again from "
            "where it was recorded"
        )
    if damages:
        artifacts.write_file(out, contents.copy)
    return Recovery(not damages, dict(messages), contents.seconds, orphans, tuple(damages))
