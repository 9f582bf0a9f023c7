"""MCAP records of a file that is whole, still grows or was cut off: bytes in, records of the mcap library out.

The library's own readers need a file that ends as it should. Here a record counts as soon as it lies whole in the
file, a chunk only if its length and its checksum are right.
"""

import io
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias, cast

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import breakup_chunk

from softfin.core.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""

HEAD = struct.Struct("<BQ")
"""Opcode and length, before each record."""

MESSAGE_HEAD_BYTES = 22
"""Bytes of a message's record before its data."""

LARGEST_BYTES = 64 * 2**20
"""Largest record, or unpacked chunk, that is read; ROS 2 closes its chunks below one megabyte."""

Record: TypeAlias = Schema | Channel | Message | Footer

_KINDS: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.FOOTER: Footer}

READ = frozenset({*_KINDS, Opcode.MESSAGE, Opcode.CHUNK})
"""Opcodes of the records whose content is read; others (indexes, attachments) are passed over."""


class RawRecord(NamedTuple):
    """A record before it is decoded."""

    opcode: int
    start: int
    """First byte within the file."""
    end: int
    """Byte of the file that follows the record."""
    content: bytes
    """Bytes behind opcode and length; empty unless the opcode is in `READ`."""


def read_records(file: io.BufferedIOBase, start: int, size: int) -> Iterator[RawRecord]:
    """Yield the whole records between two bytes of a file; raises LogError at bytes that cannot be a record."""
    while start + HEAD.size <= size:
        file.seek(start)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack(head)
        if not opcode and not length:
            # Over a network, and after a power cut, the length of a file can be seen before its bytes.
            return
        is_read = opcode in READ
        if not opcode or (opcode != Opcode.ATTACHMENT and length > LARGEST_BYTES):
            raise LogError(f"a record of kind {opcode} and {length:,} bytes at byte {start:,}")
        end = start + HEAD.size + length
        if end > size:
            return
        content = file.read(length) if is_read else b""
        if is_read and len(content) < length:
            return
        yield RawRecord(opcode, start, end, content)
        start = end


def decode(record: RawRecord) -> list[Record]:
    """Decode a record, of a chunk all that it holds; raises LogError where it is damaged."""
    try:
        if record.opcode == Opcode.CHUNK:
            return _unpack(record.content)
        stream = ReadDataStream(io.BytesIO(record.content))
        if record.opcode == Opcode.MESSAGE:
            if len(record.content) < MESSAGE_HEAD_BYTES:
                raise LogError("a message that is too short")
            return [Message.read(stream, len(record.content))]
        return [_KINDS[record.opcode].read(stream)] if record.opcode in _KINDS else []
    except (McapError, zstandard.ZstdError, ValueError, OverflowError, RuntimeError, EOFError, struct.error) as error:
        what = "chunk" if record.opcode == Opcode.CHUNK else "record"
        raise LogError(f"a {what} that cannot be decoded ({' '.join(str(error).split())})") from None


def _unpack(content: bytes) -> list[Record]:
    chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
    if chunk.uncompressed_size > LARGEST_BYTES:
        raise LogError(f"a chunk of {chunk.uncompressed_size:,} bytes, allowed are {LARGEST_BYTES:,}")
    if chunk.compression not in ("", "lz4", "zstd"):
        raise LogError(f"a chunk of unknown compression {chunk.compression!r}")
    return cast(list[Record], breakup_chunk(chunk, validate_crc=True))
