"""RDT, the protocol of ATI's Ethernet force sensors: requests of 8 bytes out, records of 36 bytes
in; pure.

Layout and status bits of the ATI manual 9610-05-Ethernet Axia (the bits differ from those of the
older Net F/T; none was seen on a real sensor). Every field is big-endian.
"""

import enum
import struct
from typing import NamedTuple

HEADER = 0x1234

REQUEST = struct.Struct("!HHI")
RECORD = struct.Struct("!IIIiiiiii")

OVER_RANGE = 0xC0000000
"""Status of a record whose force or torque is out of range."""

SUMMARY_BIT = 31
BUSY_BIT = 3

BUSY = 0x80000008
"""Status of a sensor that is busy with its settings, as the manual prints it."""


class RdtCommand(enum.IntEnum):
    """Commands of the Axia that softfin uses; it answers neither STOP nor BIAS."""

    STOP = 0x0000
    START_OLD = 0x0001
    """Another code of START."""
    START = 0x0002
    """One record in each datagram."""
    BIAS = 0x0042


class RdtRecord(NamedTuple):
    """One reading of the sensor."""

    rdt_sequence: int
    """Number in this stream: starts at 1, rolls over from 2^32 - 1 to 0."""
    ft_sequence: int
    """Number since the sensor was switched on; a request does not reset it."""
    status: int
    counts: tuple[int, int, int, int, int, int]
    """Fx, Fy, Fz, Tx, Ty, Tz in the sensor's counts."""


def encode_request(command: RdtCommand, count: int = 0) -> bytes:
    """The datagram of a command; `count` records, 0 for no end."""
    return REQUEST.pack(HEADER, command, count)


def decode_request(datagram: bytes) -> tuple[RdtCommand, int] | None:
    """Command and number of records of a client's datagram; None if it is not a valid request."""
    if len(datagram) != REQUEST.size:
        return None
    header, command, count = REQUEST.unpack(datagram)
    return (RdtCommand(command), count) if header == HEADER and command in set(RdtCommand) else None


def encode_record(record: RdtRecord) -> bytes:
    """The bytes of one record as the sensor sends it."""
    return RECORD.pack(record.rdt_sequence, record.ft_sequence, record.status, *record.counts)


def decode_record(datagram: bytes) -> RdtRecord | None:
    """The record in a datagram; None if its size is another one."""
    if len(datagram) != RECORD.size:
        return None
    rdt, ft, status, *counts = RECORD.unpack(datagram)
    return RdtRecord(rdt, ft, status, tuple(counts))


def wrapped_step(before: int, after: int) -> int:
    """Return the short way from one number of 32 bits to another; negative if it goes back."""
    return (after - before + 2**31) % 2**32 - 2**31


class StatusBit(NamedTuple):
    """One bit of the status word."""

    name: str
    is_error: bool
    """An error stops the fin; any other bit is a note: the readings are valid, or nothing can be
    done about it."""
    remedy: str

    def __str__(self) -> str:
        return f"{self.name}; {self.remedy}"


STATUS_BITS = {
    0: StatusBit(
        "its temperature is out of range",
        True,
        "let it reach the water's temperature, check the cooling",
    ),
    1: StatusBit("its supply voltage is out of range", True, "supply 12 to 32 V, check the cable"),
    2: StatusBit("a gage is broken", True, "send the sensor to ATI"),
    BUSY_BIT: StatusBit(
        "it is busy with its settings", False, "wait, and do not use its web pages"
    ),
    5: StatusBit(
        "it reports an unspecified error", True, "switch it off and on, check its web page"
    ),
    7: StatusBit(
        "its calibration cannot be read",
        True,
        "switch it off and on; if that fails, send it to ATI",
    ),
    16: StatusBit(
        "one of its own thresholds was passed",
        False,
        "clear the monitor conditions on its web page",
    ),
    27: StatusBit(
        "a gage is out of range", True, "remove the load; if the error stays, the sensor is damaged"
    ),
    28: StatusBit("its forces are simulated", False, "switch the simulation off on its web page"),
    29: StatusBit("its calibration is damaged (checksum)", True, "send the sensor to ATI"),
    30: StatusBit(
        "force or torque is out of its range", True, "remove the load, check the fin's mount"
    ),
}


def decode_status(status: int) -> tuple[StatusBit, ...]:
    """Errors and notes of a status word of 32 bits.

    Bit 31 is the summary of all errors: it counts by itself only where no other bit explains it.
    """
    summary = bool(status >> SUMMARY_BIT & 1)
    numbers = {number for number in range(SUMMARY_BIT) if status >> number & 1}
    bits = [bit for number, bit in STATUS_BITS.items() if number in numbers]
    is_explained = BUSY_BIT in numbers or any(bit.is_error for bit in bits)
    if numbers - set(STATUS_BITS) or (summary and not is_explained):
        remedy = "check the sensor's web page, switch it off and on"
        bits.append(StatusBit(f"its status 0x{status:08X} has unspecified bits", summary, remedy))
    return tuple(bits)
