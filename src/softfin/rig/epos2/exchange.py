"""What goes to and fro between host and drive: SYNC, process data, heartbeats, new targets, and the stop.

Frames are taken in the receiver's thread, everything else is sent from the caller's. Nothing that could move the fin is
sent but under the lock, with `armed` set: so nothing follows a stop.
"""

from collections.abc import Callable
from typing import NamedTuple

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import BusConfig, DriveConfig, Units
from softfin.rig.epos2.seen import ALL, Seen
from softfin.rig.epos2.target import Handshake, Setpoint
from softfin.rig.epos2.wire import Wire

PATIENCE_TICKS = 6
"""In which the drive must acknowledge a target; its statuswords come once a tick."""
LOCK_TIMEOUT_S = 0.05
"""A thread that hangs in a send must not keep a stop from going out."""

_WORD_AND_TARGET = objects.layout(objects.TAKEN[0])
_VELOCITY = objects.layout(objects.TAKEN[1])


class DriveReading(NamedTuple):
    """The newest that the drive said."""

    time: float
    """The SYNC that the drive sampled its position at [s]."""
    angle: float
    """[rad]"""
    velocity: float
    """[rad/s]"""
    current: float
    """Of the motor [A]."""
    following_error: float
    """Angle demanded less angle [rad]."""
    statusword: int
    state: State | None
    new: bool
    """Whether all of it answers the SYNC of this reading."""


class Exchange:
    """`on_fault(line)` is called in the receiver's thread within milliseconds of a fault."""

    def __init__(
        self, bus: BusConfig, config: DriveConfig, clock: Clock, on_fault: Callable[[str], None] | None
    ) -> None:
        self._config, self._units, self.clock, self._on_fault = config, Units.of(config), clock, on_fault
        self.wire = Wire(bus, config.node, self._take, self._troubled, clock)
        self.news = clock.condition()
        self.reset()

    def reset(self) -> None:
        """As before the first frame."""
        self.seen = Seen(self._config.node)
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
        with self.news:
            self.seen.synchronised(self.clock())
            self.attempt(objects.SYNC, b"")
            self.news.wait_for(lambda: self.seen.fresh == ALL, timeout)
            self._shake()
            return self._reading()

    def beat(self) -> None:
        """Our heartbeat."""
        self.attempt(objects.HEARTBEAT + self._config.host_node, bytes([objects.OPERATIONAL]))

    def nmt(self, command: int) -> None:
        """A command to the node's state."""
        self.wire.send(objects.NMT, bytes([command, self._config.node]))

    def attempt(self, cob_id: int, data: bytes) -> None:
        """Send in the loop, where a bus that fails is a complaint and no error."""
        try:
            self.wire.send(cob_id, data)
        except DeviceError as error:
            self.trouble = str(error)

    def offer(self, setpoint: Setpoint) -> None:
        """A new target; raises DeviceError where the drive is not enabled."""
        with self.news:
            if not self.armed:
                raise DeviceError("drive is not enabled; enable it before it is asked to move")
            self.handshake.offer(setpoint)
            self._shake()

    def control(self, word: int) -> None:
        """A controlword, without a new target."""
        self._order(word, self.seen.position)

    def refuse_halted(self, halts: int) -> None:
        """Raises DeviceError where it was stopped since."""
        if self.halts != halts:
            raise DeviceError("drive was stopped while it was being enabled; enable it again")

    def brake(self) -> bool:
        """Quick stop at once, from any thread; nothing is enabled or moved after it. False where a send hangs."""
        locked = self.news.acquire(timeout=LOCK_TIMEOUT_S)
        try:
            self.armed = False
            self.halts += 1
            self.handshake.clear()
            if self.owned:
                self.insist(cia402.QUICK_STOP)
        finally:
            if locked:
                self.news.release()
        return locked

    def insist(self, word: int) -> bool:
        """By process data; where that fails or the node does not take them, by SDO; whether the bus took any of it."""
        sent = True
        try:
            self.control(word)
        except DeviceError as error:
            sent, self.trouble = False, str(error)
        if not sent or self.seen.nmt != objects.OPERATIONAL:
            try:
                self.wire.shout(objects.CONTROLWORD, word)
                sent = True
            except DeviceError as error:
                self.trouble = str(error)
        return sent

    def _reading(self) -> DriveReading:
        seen, units = self.seen, self._units
        angle = units.angle(seen.position)
        return DriveReading(
            seen.position_time,
            angle,
            units.velocity(seen.velocity),
            seen.current / 1000,
            units.angle(seen.demand) - angle,
            seen.statusword,
            seen.state,
            seen.fresh == ALL,
        )

    def _take(self, cob_id: int, data: bytes) -> None:
        with self.news:
            trouble = self.seen.take(cob_id, data, self.clock())
            if cob_id == objects.TPDO[0] + self._config.node:
                self._shake()
            self.news.notify_all()
        if trouble:
            self._tell(trouble)

    def _troubled(self, line: str) -> None:
        self.trouble = line
        self._tell(line)

    def _tell(self, line: str) -> None:
        if self._on_fault:
            try:
                self._on_fault(line)
            except Exception as error:
                # The receiver's thread must live on: it also brings the answers to the stop.
                self.trouble = f"{line} (and what was to be done then failed: {error})"

    def _shake(self) -> None:
        """Carry the hand-shake on, as far as the newest statusword lets it."""
        if not self.armed:
            return
        try:
            step = self.handshake.step(self.seen.has(Bit.ACKNOWLEDGED), self.clock())
            if isinstance(step, Setpoint):
                self.wire.send(objects.RPDO[1] + self._config.node, _VELOCITY.pack(step.rpm))
                self._order(cia402.NEW_TARGET, step.counts)
            elif step:
                target = self.handshake.current
                self._order(cia402.ENABLE_OPERATION, target.counts if target else self.seen.position)
        except DeviceError as error:
            self.trouble = str(error)

    def _order(self, word: int, counts: int) -> None:
        self.wire.send(objects.RPDO[0] + self._config.node, _WORD_AND_TARGET.pack(word, counts))
