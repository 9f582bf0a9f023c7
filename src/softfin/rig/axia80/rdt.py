"""RDT, the protocol of ATI's Ethernet force sensors: requests of 8 bytes out, records of 36 bytes in; pure.

Layout of the ATI manual 9610-05-Ethernet Axia (RDT protocol); every field is big-endian.
"""

import enum
import struct
from typing import NamedTuple, TypeAlias

HEADER = 0x1234

REQUEST = struct.Struct("!HHI")
RECORD = struct.Struct("!IIIiiiiii")

MOST_RECORDS = 40
"""In one datagram: as many as an Ethernet frame of 1500 bytes holds."""

Counts: TypeAlias = tuple[int, int, int, int, int, int]
"""Fx, Fy, Fz, Tx, Ty, Tz as the sensor counts them."""


class Order(enum.IntEnum):
    """What the Axia can be asked for; it answers neither STOP nor BIAS."""

    STOP = 0x0000
    START_OLD = 0x0001
    """The same as START on an Axia."""
    START = 0x0002
    """A record a datagram."""
    START_BLOCKS = 0x0003
    """Several records a datagram, as many as the sensor's own settings say."""
    BIAS = 0x0042


class Request(NamedTuple):
    """What a client asks for."""

    order: Order
    wanted: int
    """Records; 0 is without end."""


class Record(NamedTuple):
    """One reading of the sensor."""

    rdt_sequence: int
    """Of this stream: starts at 1, rolls over from 2^32 - 1 to 0."""
    ft_sequence: int
    """Of the sensor since it was switched on; a request does not reset it."""
    status: int
    counts: Counts


def encode_request(order: Order, count: int = 0) -> bytes:
    """The datagram that asks for it."""
    return REQUEST.pack(HEADER, order, count)


def decode_request(datagram: bytes) -> Request | str:
    """What a client asks for, or why that cannot be told."""
    if len(datagram) != REQUEST.size:
        return f"{len(datagram)} bytes; a request has {REQUEST.size}"
    header, order, count = REQUEST.unpack(datagram)
    if header != HEADER:
        return f"header 0x{header:04X}; a request has 0x{HEADER:04X}"
    if order not in Order._value2member_map_:
        return f"command 0x{order:04X} is none of an Axia's"
    return Request(Order(order), count)


def encode_record(record: Record) -> bytes:
    """As the sensor sends it."""
    return RECORD.pack(record.rdt_sequence, record.ft_sequence, record.status, *record.counts)


def decode_records(datagram: bytes) -> tuple[Record, ...] | str:
    """The records in a datagram, or why it cannot be one of the sensor's."""
    if not datagram or len(datagram) % RECORD.size:
        return f"{len(datagram)} bytes; records have {RECORD.size} each"
    if len(datagram) > MOST_RECORDS * RECORD.size:
        return f"{len(datagram)} bytes; a datagram holds {MOST_RECORDS * RECORD.size} at most"
    return tuple(
        Record(rdt, ft, status, (fx, fy, fz, tx, ty, tz))
        for rdt, ft, status, fx, fy, fz, tx, ty, tz in RECORD.iter_unpack(datagram)
    )
