"""What was heard of the drive: process data, heartbeats and emergencies decoded from their frames; pure."""

import struct
from collections import Counter

from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.faults import fault_line

_SENT = tuple(objects.layout(each) for each in objects.SENT)
_EMERGENCY = struct.Struct("<HB5x")
ALL = (1 << len(_SENT)) - 1
MISSING_S = 0.1
"""Longest that velocity, current and demand may be older than the position [s], whose own age the loop judges."""


class Seen:
    """The newest of everything; `take` returns a line where a frame says that something has gone wrong."""

    def __init__(self, node: int) -> None:
        self._node = node
        self.statusword = self.position = self.velocity = self.current = self.demand = 0
        self.fresh = 0
        """A bit for each process datum that came since the last SYNC."""
        self.ever = 0
        """A bit for each process datum that came at all."""
        self.sync_time = 0.0
        """When the last SYNC was sent: the moment that the drive samples for its answers [s]."""
        self.times = [0.0] * len(_SENT)
        """The SYNC before the newest of each process datum [s]."""
        self.heartbeat_time = 0.0
        self.nmt: int | None = None
        self.emergency: int | None = None
        self.rebooted = False
        self.counters: Counter[str] = Counter()

    @property
    def state(self) -> State | None:
        """None before the first statusword, and for one that no EPOS2 sends."""
        return cia402.decode(self.statusword) if self.ever & 1 else None

    @property
    def position_time(self) -> float:
        """The SYNC before the newest position [s]."""
        return self.times[0]

    def missing(self) -> str | None:
        """Where the position comes and others do not: what safety looks at must not be old."""
        oldest = min(self.times)
        late = self.position_time - oldest
        if self.ever != ALL or late <= MISSING_S:
            return None
        number = self.times.index(oldest) + 1
        return f"drive's process data {number} are missing for {late:.2f} s; look at the bus and other programs on it"

    def has(self, bit: Bit) -> bool:
        """Whether a bit of the statusword is set."""
        return bool(self.ever & 1 and self.statusword & bit)

    def synchronised(self, now: float) -> None:
        """A SYNC is about to be sent."""
        if self.ever == ALL and self.fresh != ALL:
            self.counters["syncs without all answers"] += 1
        self.fresh, self.sync_time = 0, now

    def take(self, cob_id: int, data: bytes, now: float) -> str | None:
        """One frame of the bus."""
        function, node = cob_id & 0x780, cob_id & 0x7F
        if node != self._node:
            return None
        if function in objects.TPDO:
            return self._process_data(objects.TPDO.index(function), data)
        if function == objects.HEARTBEAT:
            return self._heartbeat(data, now)
        if function == objects.EMERGENCY:
            return self._emergency(data)
        return None

    def fault(self) -> str | None:
        """The drive's fault, by its emergency or its statusword."""
        if self.emergency is not None:
            return fault_line(self.emergency)
        if self.state in cia402.FAULTS:
            return "drive is in fault and did not say which; run: softfin rig check"
        return None

    def _process_data(self, which: int, data: bytes) -> str | None:
        if len(data) != _SENT[which].size:
            self.counters["malformed frames"] += 1
            return None
        was_well = self.state not in cia402.FAULTS and self.emergency is None
        values = _SENT[which].unpack(data)
        if which == 0:
            self.statusword, self.position = values
        elif which == 1:
            self.velocity, self.current = values
        else:
            (self.demand,) = values
        if self.fresh & 1 << which:
            self.counters["doubled answers"] += 1
        self.fresh |= 1 << which
        self.times[which] = self.sync_time
        self.ever |= 1 << which
        return self.fault() if which == 0 and was_well and self.state in cia402.FAULTS else None

    def _heartbeat(self, data: bytes, now: float) -> str | None:
        if len(data) != 1:
            self.counters["malformed frames"] += 1
            return None
        self.heartbeat_time, self.nmt = now, data[0] & 0x7F
        if self.nmt != objects.BOOT_UP:
            return None
        self.rebooted = True
        return reboot_line(self._node)

    def _emergency(self, data: bytes) -> str | None:
        if len(data) != _EMERGENCY.size:
            self.counters["malformed frames"] += 1
            return None
        code, _ = _EMERGENCY.unpack(data)
        self.counters["emergencies"] += code != 0
        # The first says why; what follows from it must not hide it.
        self.emergency = None if code == 0 else self.emergency or code
        return fault_line(code) if code else None


def reboot_line(node: int) -> str:
    """For a drive that started anew."""
    return f"drive {node} started anew; look at its supply, then zero the fin and start again"
