"""RDT, the protocol of ATI's Ethernet force sensors: encode 8-byte requests and decode 36-byte
records, without I/O.

Layout and status bits follow the ATI manual 9610-05-Ethernet Axia and have not been tested with a
real sensor. The older Net F/T uses different bits. All fields are big-endian.
"""

import enum
import struct
from typing import NamedTuple

HEADER = 0x1234

# Header, command, number of records.
REQUEST = struct.Struct("!HHI")
# RDT sequence, FT sequence, status, six counts.
RECORD = struct.Struct("!IIIiiiiii")

OVER_RANGE = 0xC0000000
"""Status of a record with force or torque out of range."""

SUMMARY_BIT = 31
BUSY_BIT = 3

BUSY = 0x80000008
"""Status of a sensor that is busy with its settings, according to the manual."""


class RdtCommand(enum.IntEnum):
    """Axia commands that softfin sends; the sensor does not acknowledge STOP."""

    STOP = 0x0000
    START = 0x0002
    """Start streaming with one record per datagram."""


class RdtRecord(NamedTuple):
    """One sensor reading."""

    rdt_sequence: int
    """Sequence number in this stream, which starts at 1 and wraps from 2^32 - 1 to 0."""
    ft_sequence: int
    """Sample counter since the sensor was switched on; a request does not reset it."""
    status: int
    counts: tuple[int, int, int, int, int, int]
    """Fx, Fy, Fz, Tx, Ty, Tz [counts]."""


def encode_request(command: RdtCommand) -> bytes:
    """Return the datagram for a command; a stream is endless."""
    return REQUEST.pack(HEADER, command, 0)


def decode_request(datagram: bytes) -> RdtCommand | None:
    """Return the command in a client datagram; None if the datagram is not a valid request."""
    if len(datagram) != REQUEST.size:
        return None
    header, command, _ = REQUEST.unpack(datagram)
    return RdtCommand(command) if header == HEADER and command in set(RdtCommand) else None


def encode_record(record: RdtRecord) -> bytes:
    """Return the bytes of one record as sent by the sensor."""
    return RECORD.pack(record.rdt_sequence, record.ft_sequence, record.status, *record.counts)


def decode_record(datagram: bytes) -> RdtRecord | None:
    """Return the record in a datagram; None if its size is wrong."""
    if len(datagram) != RECORD.size:
        return None
    rdt, ft, status, *counts = RECORD.unpack(datagram)
    return RdtRecord(rdt, ft, status, tuple(counts))


class StatusBit(NamedTuple):
    """One bit of the status word."""

    name: str
    is_error: bool
    """Whether the bit stops the fin. Other bits are only notes, because the readings remain valid
    or no action is possible."""
    remedy: str

    def __str__(self) -> str:
        return f"{self.name}; {self.remedy}"


STATUS_BITS = {
    0: StatusBit(
        "temperature is out of range",
        True,
        "let the sensor reach the water temperature, and check the cooling",
    ),
    1: StatusBit("supply voltage is out of range", True, "supply 12 to 32 V and check the cable"),
    2: StatusBit("a gauge is broken", True, "send the sensor to ATI"),
    BUSY_BIT: StatusBit("busy with its settings", False, "wait and do not use its web pages"),
    5: StatusBit(
        "reports an unspecified error", True, "switch it off and on, and check its web page"
    ),
    7: StatusBit(
        "calibration cannot be read",
        True,
        "switch the sensor off and on; if that fails, send it to ATI",
    ),
    16: StatusBit(
        "a threshold set in the sensor was exceeded",
        False,
        "clear the monitor conditions on its web page",
    ),
    27: StatusBit(
        "a gauge is out of range",
        True,
        "remove the load; if the error persists, the sensor is damaged",
    ),
    28: StatusBit("forces are simulated", False, "turn off the simulation on its web page"),
    29: StatusBit("calibration data is damaged (checksum)", True, "send the sensor to ATI"),
    30: StatusBit(
        "force or torque is out of range", True, "remove the load and check the mount of the fin"
    ),
}


def decode_status(status: int) -> tuple[StatusBit, ...]:
    """Return the errors and notes in a 32-bit status word.

    Bit 31 summarises all errors; it is reported only if no other bit explains it.
    """
    summary = bool(status >> SUMMARY_BIT & 1)
    numbers = {number for number in range(SUMMARY_BIT) if status >> number & 1}
    bits = [bit for number, bit in STATUS_BITS.items() if number in numbers]
    # A busy sensor also sets the summary bit, as in `BUSY`.
    is_explained = BUSY_BIT in numbers or any(bit.is_error for bit in bits)
    if numbers - set(STATUS_BITS) or (summary and not is_explained):
        remedy = "check the web page of the sensor, and switch the sensor off and on"
        bits.append(StatusBit(f"status 0x{status:08X} has unspecified bits", summary, remedy))
    return tuple(bits)
