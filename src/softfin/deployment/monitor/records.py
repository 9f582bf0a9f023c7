"""Bytes of an MCAP file in, its whole records out; nothing that a length promises is believed before it is there.

The format is that of the MCAP specification, version 0. Readers of finished files need its end, which a recording
that still grows has not got.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from softfin.errors import LogError

MAGIC = b"\x89MCAP0\r\n"

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x09

WANTED = frozenset({FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK})

MOST_BYTES = 64 * 2**20
"""Of one record, and of a chunk unpacked: many times what recorders write, and no harm to hold."""

MOST_ATTACHED_BYTES = 2**34
"""Attachments are skipped, never read."""

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_CHANNEL = struct.Struct("<HHI")
_MESSAGE = struct.Struct("<HIQQ")


class Record(NamedTuple):
    """One record of the file."""

    opcode: int
    body: bytes
    """Empty where nothing here is made of it."""
    end: int
    """Byte of the file that follows it."""


class Channel(NamedTuple):
    """Which topic the messages of a number belong to."""

    number: int
    schema: int
    topic: str
    encoding: str


class Message(NamedTuple):
    """One message, still encoded."""

    channel: int
    logged_ns: int
    data: bytes


def whole_records(file: io.BufferedIOBase, start: int, size: int) -> Iterator[Record]:
    """Those from byte `start` that are there in full; raises LogError where no record can be."""
    while start + _HEAD.size <= size:
        file.seek(start)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return
        opcode, length = _HEAD.unpack(head)
        if opcode == 0 and length == 0:
            # Over a network, the length of a file can be seen before its bytes.
            return
        if opcode == 0 or length > (MOST_ATTACHED_BYTES if opcode == ATTACHMENT else MOST_BYTES):
            what = f"a record of kind {opcode} and {length:,} bytes cannot be"
            raise LogError(f"damaged at byte {start:,} ({what}); softfin bag recover saves what is whole")
        end = start + _HEAD.size + length
        if end > size:
            return
        body = file.read(length) if opcode in WANTED else b""
        if opcode in WANTED and len(body) < length:
            return
        yield Record(opcode, body, end)
        start = end


def unpacked(chunk: bytes) -> Iterator[Record]:
    """The records of a chunk, none where its checksum is wrong; raises LogError where it is damaged."""
    try:
        *_, size, crc, named = _CHUNK.unpack_from(chunk)
        middle = _CHUNK.size + named
        compression = chunk[_CHUNK.size : middle].decode()
        (length,) = struct.unpack_from("<Q", chunk, middle)
        packed = chunk[middle + 8 : middle + 8 + length]
        if len(packed) < length or size > MOST_BYTES:
            raise LogError("a chunk whose lengths cannot be")
        data = _decompressed(packed, compression, size)
    except (struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise LogError(f"a chunk that does not unpack ({error})") from None
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise LogError("a chunk whose checksum is wrong")
    end = 0
    for record in whole_records(io.BytesIO(data), 0, size):
        end = record.end
        yield record
    if end != size:
        raise LogError("a chunk that ends within a record")


def _decompressed(packed: bytes, compression: str, size: int) -> bytes:
    """At most a byte more than `size`, whatever the packed bytes would swell to."""
    if compression == "zstd":
        reader = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES).stream_reader(packed)
        return bytes(reader.read(size + 1))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    if compression:
        raise LogError(f"a chunk packed by {compression[:20]!r}; there are zstd, lz4 and none")
    return packed


def schema_of(body: bytes) -> tuple[int, str]:
    """Number and name of a schema; raises LogError."""
    try:
        (number,) = struct.unpack_from("<H", body)
        return number, _text(body, 2)[0]
    except (struct.error, UnicodeDecodeError):
        raise LogError("a schema that cannot be read") from None


def channel_of(body: bytes) -> Channel:
    """Of a channel's record; raises LogError."""
    try:
        number, schema, _ = _CHANNEL.unpack_from(body)
        topic, end = _text(body, 4)
        return Channel(number, schema, topic, _text(body, end)[0])
    except (struct.error, UnicodeDecodeError):
        raise LogError("a channel that cannot be read") from None


def message_of(body: bytes) -> Message:
    """Of a message's record; raises LogError."""
    if len(body) < _MESSAGE.size:
        raise LogError("a message that cannot be read")
    channel, _, logged_ns, _ = _MESSAGE.unpack_from(body)
    return Message(channel, logged_ns, body[_MESSAGE.size :])


def _text(body: bytes, start: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", body, start)
    end = start + 4 + length
    if end > len(body):
        raise struct.error
    return body[start + 4 : end].decode(), end
