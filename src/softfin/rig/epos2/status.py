"""What the drive reports: process data, heartbeats and emergencies decoded from their frames, faults in words; pure.

Codes of faults: maxon "EPOS2 Firmware Specification" (rel5466) and CiA 301; the ways out are ours.
"""

from collections import Counter

from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.cia402 import Bit, State

FAULTS = {
    0x1000: ("generic error", "switch the drive off and on"),
    0x2310: ("over-current", "look for a short circuit or a blocked fin; lower the acceleration"),
    0x3210: ("over-voltage", "look at the supply; brake more gently, or add a brake resistor"),
    0x3220: ("under-voltage", "look at the supply: its voltage fell below what the drive needs"),
    0x4210: ("over-temperature", "let the drive cool down; move less or slower"),
    0x5113: ("+5 V supply too low", "look for a short circuit in the encoder's cable"),
    0x5114: ("supply of the output stage too low", "look at the supply and at its fuse"),
    0x6100: ("internal software error", "switch the drive off and on; update its firmware if it comes again"),
    0x6320: ("software parameter error", "restore the drive's defaults in EPOS Studio and tune it again"),
    0x7320: ("position sensor error", "look at the encoder and its cable; its lines must be those of the drive"),
    0x8110: ("CAN overrun, objects lost", "put fewer nodes or a higher bitrate on the bus"),
    0x8111: ("CAN overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x8120: ("CAN error passive", "look at the bus: termination, bitrate, cable"),
    0x8130: ("heartbeat of the host lost", "find out why the program hung or was killed; look at the bus's cable"),
    0x8150: ("CAN message collision", "look for a second drive with the same node number"),
    0x81FD: ("CAN bus off", "look at the bus: termination, bitrate, cable"),
    0x81FE: ("CAN receive queue overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x81FF: ("CAN transmit queue overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x8210: ("process data of a wrong length", "look for another program that writes to the same drive"),
    0x8611: ("following error", "look for a blocked fin; ask for less velocity or acceleration, or tune the drive"),
    0xFF01: ("hall sensor error", "look at the hall sensors' cable"),
    0xFF02: ("index processing error", "look at the encoder's index channel"),
    0xFF03: ("encoder resolution error", "set the encoder's lines in the drive to those of the encoder"),
    0xFF04: ("hall sensor not found", "look at the hall sensors' cable"),
    0xFF06: ("negative limit switch", "turn the fin away from its end"),
    0xFF07: ("positive limit switch", "turn the fin away from its end"),
    0xFF08: ("hall angle detection error", "look at the hall sensors' cable and at the motor's pole pairs"),
    0xFF09: ("software position limit", "turn the fin inside its limits, or zero it anew"),
    0xFF0A: ("position sensor breach", "look at the encoder and its cable"),
    0xFF0B: ("system overloaded", "look for too many messages on the bus"),
}

_SENT = tuple(objects.layout(each) for each in objects.SENT)
_SIZES = dict(zip(objects.TPDO, (each.size for each in _SENT), strict=True)) | {
    objects.HEARTBEAT: 1,
    objects.EMERGENCY: 8,
}
"""Bytes of each kind of frame."""
ALL = (1 << len(_SENT)) - 1
MISSING_S = 0.1
"""Longest that velocity, current and demand may be older than the position [s], whose own age the loop judges."""


class DriveStatus:
    """The newest values of the drive; `take` returns a line where a frame reports that something has gone wrong."""

    def __init__(self, node: int) -> None:
        self._node = node
        self.statusword = self.position = self.velocity = self.current = self.demand = 0
        self.answered = 0
        """A bit for each process datum that came since the last SYNC."""
        self.ever = 0
        """A bit for each process datum that came at all."""
        self.sync_time = 0.0
        """When the last SYNC was sent: the moment that the drive samples for its answers [s]."""
        self.times = [0.0] * len(_SENT)
        """The SYNC before the newest of each process datum [s]; the first holds the position."""
        self.heartbeat_time = 0.0
        self.nmt: int | None = None
        self.emergency: int | None = None
        self.rebooted = False
        self.counters: Counter[str] = Counter()

    @property
    def state(self) -> State | None:
        """State by the newest statusword; None before the first, and for one that no EPOS2 sends."""
        return cia402.decode(self.statusword) if self.ever & 1 else None

    def has(self, bit: Bit) -> bool:
        """Whether a bit of the statusword is set."""
        return bool(self.ever & 1 and self.statusword & bit)

    def fault(self) -> str | None:
        """The drive's fault, by its emergency or its statusword."""
        if self.emergency is not None:
            return fault_line(self.emergency)
        if self.state in cia402.FAULTS:
            return "drive is in fault and did not report which; run: softfin rig check"
        return None

    def missing(self) -> str | None:
        """Process data that stopped while the position goes on: what safety looks at must not be old."""
        oldest = min(self.times)
        late = self.times[0] - oldest
        if self.ever != ALL or late <= MISSING_S:
            return None
        number = self.times.index(oldest) + 1
        return f"drive's process data {number} are missing for {late:.2f} s; look at the bus and other programs on it"

    def reboot(self) -> str | None:
        """A line for a drive that started anew."""
        line = f"drive {self._node} started anew; look at its supply, then zero the fin and start again"
        return line if self.rebooted else None

    def synchronise(self, now: float) -> None:
        """A SYNC is about to be sent."""
        if self.ever == ALL and self.answered != ALL:
            self.counters["syncs without all answers"] += 1
        self.answered, self.sync_time = 0, now

    def take(self, cob_id: int, data: bytes, now: float) -> str | None:
        """Decode one frame of the bus; frames of other nodes change nothing."""
        function, node = cob_id & 0x780, cob_id & 0x7F
        if node != self._node or function not in _SIZES:
            return None
        if len(data) != _SIZES[function]:
            self.counters["malformed frames"] += 1
            return None
        if function in objects.TPDO:
            return self._process_data(objects.TPDO.index(function), data)
        if function == objects.HEARTBEAT:
            self.heartbeat_time, self.nmt = now, data[0] & 0x7F
            self.rebooted |= self.nmt == objects.BOOT_UP
            return self.reboot() if self.nmt == objects.BOOT_UP else None
        code = int.from_bytes(data[:2], "little")
        self.counters["emergencies"] += code != 0
        # The first names the cause; what follows from it must not hide it.
        self.emergency = None if code == 0 else self.emergency or code
        return fault_line(code) if code else None

    def _process_data(self, which: int, data: bytes) -> str | None:
        was_well = self.fault() is None
        values = _SENT[which].unpack(data)
        if which == 0:
            self.statusword, self.position = values
        elif which == 1:
            self.velocity, self.current = values
        else:
            (self.demand,) = values
        if self.answered & 1 << which:
            self.counters["doubled answers"] += 1
        self.answered |= 1 << which
        self.ever |= 1 << which
        self.times[which] = self.sync_time
        return self.fault() if which == 0 and was_well else None


def fault_line(code: int) -> str:
    """Name and way out of a fault, such as ``drive fault 0x8611, following error: look for a blocked fin; ..``."""
    name, way_out = FAULTS.get(code, ("not in softfin's list", "look it up in the EPOS2 Firmware Specification"))
    return f"drive fault 0x{code:04X}, {name}: {way_out}"
