"""The status word of an Axia80: what its bits mean and what to do about each.

Bits of the ATI manual 9610-05-Ethernet Axia, which differ from those of the older Net F/T; not seen on a real sensor.
"""

from typing import NamedTuple

OVER_RANGE = 0xC0000000
GAGE_OUT_OF_RANGE = 0x88000000
CHECKSUM = 0xA0000000
BUSY = 0x80000008
"""Printed so in the manual's table, which calls it no error elsewhere."""
SIMULATED = 0x10000000

SUMMARY_BIT = 31
BUSY_BIT = 3


class StatusBit(NamedTuple):
    """One bit of the status word."""

    name: str
    error: bool
    """Else it is a note: the readings are what they should be, or nothing can be done about it."""
    remedy: str

    def __str__(self) -> str:
        return f"{self.name}; {self.remedy}"


BITS = {
    0: StatusBit("its temperature is out of range", True, "let it reach that of the water, check the cooling"),
    1: StatusBit("its supply voltage is out of range", True, "give it 12 to 32 V, look at the cable"),
    2: StatusBit("a gage is broken", True, "send the sensor to ATI"),
    BUSY_BIT: StatusBit("it is busy with its settings", False, "wait, change nothing on its web pages"),
    5: StatusBit("it has an error that it does not name", True, "switch it off and on, look at its web page"),
    7: StatusBit("its calibration cannot be read", True, "switch it off and on; else send it to ATI"),
    16: StatusBit("one of its own thresholds was passed", False, "clear the monitor conditions on its web page"),
    27: StatusBit("a gage is out of range", True, "take the load off; if it stays, the sensor is damaged"),
    28: StatusBit("its forces are simulated", False, "switch the simulation off on its web page"),
    29: StatusBit("its calibration is damaged (checksum)", True, "send the sensor to ATI"),
    30: StatusBit("force or torque is out of its range", True, "take the load off, look at the fin's mount"),
}

UNNAMED = "look at the sensor's web page, switch it off and on"


class Status(NamedTuple):
    """A status word, read."""

    errors: tuple[StatusBit, ...]
    notes: tuple[StatusBit, ...]


def decode_status(status: int) -> Status:
    """Errors and notes of a status word of 32 bits.

    Bit 31 sums the errors up: it is one of its own only where no other bit explains it.
    """
    known = [bit for number, bit in BITS.items() if status >> number & 1]
    unknown = [number for number in range(SUMMARY_BIT) if status >> number & 1 and number not in BITS]
    errors = [bit for bit in known if bit.error]
    notes = [bit for bit in known if not bit.error]
    summed = status >> SUMMARY_BIT & 1
    if unknown:
        numbers = ", ".join(map(str, unknown))
        strange = StatusBit(f"unknown status bits are set ({numbers} of 0x{status:08X})", bool(summed), UNNAMED)
        (errors if summed else notes).append(strange)
    if summed and not errors and not status >> BUSY_BIT & 1:
        errors.append(StatusBit(f"it reports an error without a name (0x{status:08X})", True, UNNAMED))
    return Status(tuple(errors), tuple(notes))
