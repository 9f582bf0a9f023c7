"""Reads bags that are complete, growing, truncated or damaged, and converts them to records of the
mcap library or to a complete bag.

The readers of the mcap library need a properly closed file. This module reads a record as soon as
it is complete in the file, and a chunk only if its length and checksum are correct.
"""

import io
import os
import struct
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

from softfin.core.errors import ArtifactError, InputError, LogError, one_line
from softfin.core.json_object import JsonObject
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import start_writer
from softfin.storage.formats import check_file_format

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""

HEAD = struct.Struct("<BQ")
"""Header of each record: opcode and length."""

MAX_RECORD_BYTES = 2**30
"""Maximum size of a record or unpacked chunk [bytes]. ROS 2 closes chunks below one megabyte, but
chunks with camera images are often larger."""

BagRecord: TypeAlias = Schema | Channel | Message | Footer

_KINDS: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.FOOTER: Footer}


class SizeError(InputError):
    """Raised for a record that is too large to be read but not damaged."""


class RawRecord(NamedTuple):
    """A record before it is decoded."""

    opcode: int
    start: int
    end: int
    """Offsets of the first byte of the record and of the byte after the record."""
    content: bytes
    """Bytes after the header; empty for an attachment."""


class Damage(NamedTuple):
    """A part of the file that cannot be read."""

    byte: int
    """Offset of the first byte."""
    reason: str


def read_records(file: io.BufferedIOBase, start: int, size: int) -> Iterator[RawRecord]:
    """Yield the complete records between two offsets of a file; raises LogError if the bytes cannot
    be a record."""
    while start + HEAD.size <= size:
        file.seek(start)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size or not any(head):
            # On a network share or after a power cut, a file can have its final length before its
            # contents.
            return
        opcode, length = HEAD.unpack(head)
        end = start + HEAD.size + length
        is_large = opcode != Opcode.ATTACHMENT and length > MAX_RECORD_BYTES
        if not opcode or (is_large and end > size):
            raise LogError(
                f"invalid record of kind {opcode} with {length:,} bytes at byte {start:,}"
            )
        if end > size:
            return
        if is_large:
            raise _size_error(length, start)
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
            raise _size_error(chunk.uncompressed_size, record.start)
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


def _size_error(size: int, start: int) -> SizeError:
    return SizeError(
        f"chunk of {size:,} bytes at byte {start:,} is too large, limit {MAX_RECORD_BYTES:,}; "
        "write the bag again with smaller chunks, or without the topic that makes them large"
    )


def scan(path: Path) -> Iterator[BagRecord | Damage]:
    """Yield the records of a file in order, including records in chunks and damaged parts."""
    try:
        with path.open("rb") as file:
            yield from _scan(file, path)
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read ({error.strerror}); use the path of a .mcap file"
        ) from None
    except SizeError as error:
        raise SizeError(f"{path}: {error}") from None


def check_bag(path: Path) -> None:
    """Raise LogError unless the file is complete and in a format that this version reads."""
    for item in scan(path):
        if isinstance(item, Channel):
            check_file_format("recording", item.metadata, str(path))
        elif isinstance(item, Damage):
            raise LogError(
                f"{path}: incomplete or damaged at byte {item.byte:,} ({item.reason}); to save its "
                f"readable contents, run softfin bag recover {path}"
            )


def _scan(file: io.BufferedIOBase, path: Path) -> Iterator[BagRecord | Damage]:
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError(
            f"{path}: not an MCAP file, because it does not start with the MCAP signature; use a "
            "bag that softfin or ros2 bag recorded as MCAP"
        )
    size = os.fstat(file.fileno()).st_size
    at = len(MAGIC)
    reason = "incomplete record"
    try:
        for record in read_records(file, at, size):
            if record.opcode == Opcode.FOOTER and file.read() == MAGIC:
                return
            at = record.end
            try:
                yield from decode_bag_record(record)
            except LogError as error:
                # The next record may still be readable.
                yield Damage(record.start, str(error))
    except LogError as error:
        reason = str(error)
    yield Damage(at, reason)


class Recovery(NamedTuple):
    """Result of a recovery."""

    messages: dict[str, int]
    """Number of saved messages per topic."""
    damages: tuple[Damage, ...]
    """Unreadable parts of the file; if there are none, no file was written."""

    def to_dict(self) -> JsonObject:
        """Convert for JSON."""
        return {
            "messages": self.messages,
            "damages": [damage._asdict() for damage in self.damages],
        }


def recovered_path(path: Path) -> Path:
    """Return the default output path: ``run.recovered.mcap`` next to ``run.mcap``."""
    return path.with_name(f"{path.stem}.recovered.mcap")


def recover(path: Path, out: Path, overwrite: bool = False) -> Recovery:
    """Write all readable messages of a damaged file to a new bag; raises LogError if no message is
    readable, and ArtifactError if `out` exists. An intact file is not copied."""
    if out.resolve() == path.resolve():
        raise ArtifactError(f"{out}: is the damaged recording itself; choose a different --out")
    artifacts.check_file(out, overwrite)
    damages = [item for item in scan(path) if isinstance(item, Damage)]
    if not damages:
        return Recovery({}, ())
    messages = Counter[str]()

    def copy(file: BinaryIO) -> None:
        writer = start_writer(file)
        channels = _copy_channels(path, writer)
        for item in scan(path):
            if isinstance(item, Message) and item.channel_id in channels:
                topic, channel_id = channels[item.channel_id]
                writer.add_message(
                    channel_id, item.log_time, item.data, item.publish_time, item.sequence
                )
                messages[topic] += 1
        writer.finish()
        if not messages:
            raise LogError(
                f"{path}: contains no readable messages ({damages[0].reason}); copy it again "
                "from where it was recorded"
            )

    artifacts.write_file(out, copy)
    return Recovery(dict(messages), tuple(damages))


def _copy_channels(path: Path, writer: Any) -> dict[int, tuple[str, int]]:
    """Define the channels of a bag in a new bag; return their topics and new numbers.

    If the first chunk is lost, definitions may follow their messages, because the index repeats the
    definitions.
    """
    # In MCAP, schema id 0 means "no schema".
    schemas = {0: 0}
    channels: dict[int, tuple[str, int]] = {}
    for item in scan(path):
        if isinstance(item, Schema) and item.id not in schemas:
            schemas[item.id] = writer.register_schema(item.name, item.encoding, item.data)
        elif isinstance(item, Channel) and item.id not in channels:
            schema = schemas.get(item.schema_id, 0)
            number = writer.register_channel(
                item.topic, item.message_encoding, schema, item.metadata
            )
            channels[item.id] = (item.topic, number)
    return channels
