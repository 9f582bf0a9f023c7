"""Bytes of an MCAP file in, its whole records out; nothing that a length promises is believed before it is there.

The format is that of the MCAP specification, version 0. Readers of finished files need its end, which a recording
that still grows has not got.
"""

import io
import struct
from collections.abc import Iterator
from typing import NamedTuple

from softfin.core.errors import LogError
from softfin.storage.bag.chunks import CHANNEL, CHUNK, FOOTER, LARGEST, MESSAGE, RECORD_HEAD, SCHEMA

ATTACHMENT = 0x09

WANTED = frozenset({FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK})

MOST_ATTACHED_BYTES = 2**34
"""Attachments are skipped, never read."""

_CHANNEL = struct.Struct("<HHI")
_MESSAGE = struct.Struct("<HxxxxQ").unpack_from

MESSAGE_HEAD = 22
"""Bytes of a message's record before its data."""


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


def whole_records(file: io.BufferedIOBase, start: int, size: int) -> Iterator[Record]:
    """Those from byte `start` that are there in full; raises LogError where no record can be."""
    while start + RECORD_HEAD.size <= size:
        file.seek(start)
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode == 0 and length == 0:
            # Over a network, the length of a file can be seen before its bytes.
            return
        if opcode == 0 or length > (MOST_ATTACHED_BYTES if opcode == ATTACHMENT else LARGEST):
            what = f"a record of kind {opcode} and {length:,} bytes cannot be"
            raise LogError(f"damaged at byte {start:,} ({what}); softfin bag recover saves what is whole")
        end = start + RECORD_HEAD.size + length
        if end > size:
            return
        body = file.read(length) if opcode in WANTED else b""
        if opcode in WANTED and len(body) < length:
            return
        yield Record(opcode, body, end)
        start = end


def schema_of(body: bytes | memoryview) -> tuple[int, str]:
    """Number and name of a schema; raises LogError."""
    try:
        (number,) = struct.unpack_from("<H", body)
        return number, _text(body, 2)[0]
    except (struct.error, UnicodeDecodeError):
        raise LogError("a schema that cannot be read") from None


def channel_of(body: bytes | memoryview) -> Channel:
    """Of a channel's record; raises LogError."""
    try:
        number, schema, _ = _CHANNEL.unpack_from(body)
        topic, end = _text(body, 4)
        return Channel(number, schema, topic, _text(body, end)[0])
    except (struct.error, UnicodeDecodeError):
        raise LogError("a channel that cannot be read") from None


def message_of(body: bytes | memoryview) -> tuple[int, int]:
    """Channel of a message and when it was logged [ns]; its data begin at `MESSAGE_HEAD`. Raises LogError."""
    if len(body) < MESSAGE_HEAD:
        raise LogError("a message that cannot be read")
    channel, logged_ns = _MESSAGE(body)
    return channel, logged_ns


def _text(body: bytes | memoryview, start: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", body, start)
    end = start + 4 + length
    if end > len(body):
        raise struct.error
    return bytes(body[start + 4 : end]).decode(), end
