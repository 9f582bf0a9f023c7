"""What goes to and fro between host and drive: SYNC, process data, heartbeats, new targets, and the quick stop.

Frames are taken in the receiver's thread, everything else is sent from the caller's. Nothing that could move the fin is
sent but under the lock, with `armed` set: so nothing follows a stop.
"""

from collections.abc import Callable
from typing import NamedTuple

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import BusConfig, Epos2Config, Units
from softfin.rig.epos2.connection import CanConnection
from softfin.rig.epos2.status import ALL, DriveStatus

PATIENCE_TICKS = 6
"""Ticks in which the drive must acknowledge a target; its statuswords come once a tick."""
LOCK_TIMEOUT_S = 0.05
"""A thread that hangs in a send must not keep a stop from going out."""

_WORD_AND_TARGET = objects.layout(objects.TAKEN[0])
_VELOCITY = objects.layout(objects.TAKEN[1])


class DriveReading(NamedTuple):
    """The newest values of the drive."""

    time: float
    """The SYNC that the drive sampled its position at [s]."""
    angle: float
    """Angle of the fin [rad]."""
    velocity: float
    """Angular velocity of the fin [rad/s]."""
    current: float
    """Current of the motor [A]."""
    following_error: float
    """Angle demanded less angle [rad]."""
    state: State | None
    new: bool
    """Whether all of it answers the SYNC of this reading."""


class Setpoint(NamedTuple):
    """A target in the drive's units."""

    counts: int
    rpm: int


class Handshake:
    """The hand-shake by which an EPOS2 takes a target; `patience` [s] is how long an answer may take.

    Bit 4 of the controlword rises with the target; the drive answers with bit 12 of the statusword; bit 4 falls, then
    bit 12 (maxon "EPOS2 Firmware Specification", rel5466). The newest target wins while another is on its way.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self.superseded = self.repeated = 0
        self.clear()

    def clear(self) -> None:
        """Forget everything: the drive was stopped, or is enabled anew."""
        self._is_raised, self._since = False, 0.0
        self._waiting: Setpoint | None = None
        self.current: Setpoint | None = None
        """The target that the drive has, or is being given."""
        self.unanswered = 0
        """Times in a row that the drive did not acknowledge the current target."""

    def offer(self, setpoint: Setpoint) -> None:
        """Give this to the drive as soon as it can take it."""
        self.superseded += self._waiting is not None
        self._waiting = setpoint

    def step(self, acknowledged: bool, now: float) -> Setpoint | bool | None:
        """What to send next: a target to raise, True to lower bit 4, or None."""
        late = now - self._since > self._patience
        if self._is_raised:
            if not (acknowledged or late):
                return None
            self._is_raised, self._since = False, now
            if acknowledged:
                self.unanswered = 0
            else:
                self.unanswered, self.repeated = self.unanswered + 1, self.repeated + 1
                self._waiting = self._waiting or self.current
            return True
        if self._waiting is None or (acknowledged and not late):
            return None
        self._since = now
        if acknowledged:
            # A drive whose bit 12 does not fall takes no target: the lowering may have been lost.
            self.unanswered += 1
            return True
        self._is_raised, self.current, self._waiting = True, self._waiting, None
        return self.current


class Exchange:
    """One drive on one bus; `on_fault(line)` is called in the receiver's thread within milliseconds of a fault."""

    def __init__(
        self, bus: BusConfig, config: Epos2Config, clock: Clock, on_fault: Callable[[str], None] | None
    ) -> None:
        self._config, self._units, self.clock, self._on_fault = config, Units.of(config), clock, on_fault
        self.connection = CanConnection(bus, config.node, self._take, self._report, clock)
        self.lock = clock.condition()
        """Guards all below; notified of every frame."""
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before the first frame."""
        self.status = DriveStatus(self._config.node)
        self.handshake = Handshake(PATIENCE_TICKS * self._config.sync_s)
        self.trouble: str | None = None
        """The newest that went wrong on the bus; it stays until the drive is connected anew."""
        self.owned = False
        """Whether this drive is ours to command."""
        self.armed = False
        """Whether targets may be sent."""
        self.halts = 0
        """Times that it was stopped: what began before a stop must not go on after it."""

    def sync_and_read(self, timeout: float) -> DriveReading:
        """Have the drive sample, wait for the answers [s]; the newest known where they do not all come."""
        status, units = self.status, self._units
        with self.lock:
            status.synchronise(self.clock())
            self.attempt(objects.SYNC, b"")
            self.lock.wait_for(lambda: status.answered == ALL, timeout)
            self._carry_on()
            angle = units.angle(status.position)
            return DriveReading(
                status.times[0],
                angle,
                units.velocity(status.velocity),
                status.current / 1000,
                units.angle(status.demand) - angle,
                status.state,
                status.answered == ALL,
            )

    def send_heartbeat(self) -> None:
        """Send the host's heartbeat."""
        self.attempt(objects.HEARTBEAT + self._config.host_node, bytes([objects.OPERATIONAL]))

    def nmt(self, command: int) -> None:
        """Send a command to the node's state (NMT)."""
        self.connection.send(objects.NMT, bytes([command, self._config.node]))

    def attempt(self, cob_id: int, data: bytes) -> None:
        """Send in the loop, where a bus that fails is a complaint and no error."""
        try:
            self.connection.send(cob_id, data)
        except DeviceError as error:
            self.trouble = str(error)

    def offer(self, setpoint: Setpoint) -> None:
        """Give the drive a new target; raises DeviceError where the drive is not enabled."""
        with self.lock:
            if not self.armed:
                raise DeviceError("drive is not enabled; enable it before it is asked to move")
            self.handshake.offer(setpoint)
            self._carry_on()

    def control(self, word: int, counts: int | None = None) -> None:
        """Send a controlword with a target; without one, where the drive is."""
        data = _WORD_AND_TARGET.pack(word, self.status.position if counts is None else counts)
        self.connection.send(objects.RPDO[0] + self._config.node, data)

    def refuse_halted(self, halts: int) -> None:
        """Raise DeviceError where the drive was stopped since it had been stopped so many times."""
        if self.halts != halts:
            raise DeviceError("drive was stopped while it was being enabled; enable it again")

    def brake(self) -> bool:
        """Quick stop at once, from any thread; nothing is enabled or moved after it. False where a send hangs."""
        locked = self.lock.acquire(timeout=LOCK_TIMEOUT_S)
        try:
            self.armed = False
            self.halts += 1
            self.handshake.clear()
            if self.owned:
                self.insist(cia402.QUICK_STOP)
        finally:
            if locked:
                self.lock.release()
        return locked

    def insist(self, word: int) -> bool:
        """Send a controlword by process data; where that fails or the node does not take them, by SDO.

        Whether the bus took any of it.
        """
        sent = True
        try:
            self.control(word)
        except DeviceError as error:
            sent, self.trouble = False, str(error)
        if not sent or self.status.nmt != objects.OPERATIONAL:
            try:
                self.connection.write_unconfirmed(objects.CONTROLWORD, word)
                sent = True
            except DeviceError as error:
                self.trouble = str(error)
        return sent

    def _take(self, cob_id: int, data: bytes) -> None:
        with self.lock:
            fault = self.status.take(cob_id, data, self.clock())
            if cob_id == objects.TPDO[0] + self._config.node:
                self._carry_on()
            self.lock.notify_all()
        if fault:
            self._tell(fault)

    def _report(self, line: str) -> None:
        self.trouble = line
        self._tell(line)

    def _tell(self, line: str) -> None:
        """Call `on_fault`; its errors must not end the receiver's thread, which also brings the answers to a stop."""
        try:
            if self._on_fault:
                self._on_fault(line)
        except Exception as error:
            self.trouble = f"{line} (and what was to be done then failed: {error})"

    def _carry_on(self) -> None:
        """Carry the hand-shake on, as far as the newest statusword lets it."""
        if not self.armed:
            return
        try:
            step = self.handshake.step(self.status.has(Bit.ACKNOWLEDGED), self.clock())
            if isinstance(step, Setpoint):
                self.connection.send(objects.RPDO[1] + self._config.node, _VELOCITY.pack(step.rpm))
                self.control(cia402.NEW_TARGET, step.counts)
            elif step:
                target = self.handshake.current
                self.control(cia402.ENABLE_OPERATION, target.counts if target else None)
        except DeviceError as error:
            self.trouble = str(error)
