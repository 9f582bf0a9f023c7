"""Exchange between host and drive: SYNC, process data, heartbeats, new targets, and the quick stop.

Frames are taken in the receiver's thread, everything else is sent from the caller's. Nothing that
could move the fin is sent but under the lock, with `armed` set: so nothing follows a stop.
"""

from collections import Counter
from collections.abc import Callable
from typing import TypeAlias

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError
from softfin.rig.epos2 import protocol
from softfin.rig.epos2.config import BusConfig, Epos2Config, Units
from softfin.rig.epos2.connection import CanConnection, download
from softfin.rig.epos2.protocol import Bit, State
from softfin.rig.lock import DeviceLock

PATIENCE_TICKS = 6
"""Ticks in which the drive must acknowledge a target; its statuswords come once a tick."""
BEATS_AFTER_STOP = 3
"""Heartbeats after a stop that the drive does not obey: an answer may be a few ticks late."""
LOCK_TIMEOUT_S = 0.05
"""A thread that hangs in a send must not keep a stop from going out."""

_SENT = tuple(protocol.layout(each) for each in protocol.SENT)
_WORD_AND_TARGET, _VELOCITY = (protocol.layout(each) for each in protocol.TAKEN)
_SIZES = {protocol.HEARTBEAT: 1, protocol.EMERGENCY: 8}
_SIZES |= {pdo: each.size for pdo, each in zip(protocol.TPDO, _SENT, strict=True)}
"""Bytes of each kind of frame."""
ALL = (1 << len(_SENT)) - 1

Setpoint: TypeAlias = tuple[int, int]
"""A target in the drive's units: position [counts] and velocity [rpm]."""


class DriveStatus:
    """The newest values of the drive; `take` returns a line where a frame reports that something
    has gone wrong."""

    def __init__(self, node: int, units: Units) -> None:
        self._node = node
        self._units = units
        self.statusword: int | None = None
        self.position = 0
        """Position [counts]."""
        self.angle = self.demand = units.angle(0)
        """Angle of the fin and the one that the drive demands [rad]."""
        self.velocity = 0.0
        """Angular velocity of the fin [rad/s]."""
        self.current = 0.0
        """Current of the motor [A]."""
        self.answered = 0
        """A bit for each process datum that came since the last SYNC."""
        self.sync_time = 0.0
        """Time of the last SYNC [s], at which the drive samples for its answers."""
        self.time = 0.0
        """The newest SYNC that all process data have answered [s]: none of the values is older."""
        self.heartbeat_time = 0.0
        self.nmt: int | None = None
        self.emergency: int | None = None
        self.rebooted = False
        self.limited_since: float | None = None
        """Time since which the drive reports that it holds back at a limit of its own [s]; None if
        it does not."""
        self.counters: Counter[str] = Counter()

    @property
    def state(self) -> State | None:
        """State by the newest statusword; None before the first, and for one that no EPOS2
        sends."""
        return None if self.statusword is None else protocol.decode(self.statusword)

    @property
    def new(self) -> bool:
        """Whether all values answer the last SYNC."""
        return self.answered == ALL

    @property
    def words(self) -> str:
        """The state for messages."""
        return (
            self.state.words
            if self.state
            else f"in no state of an EPOS2 (statusword 0x{self.statusword or 0:04X})"
        )

    def has(self, bit: Bit) -> bool:
        """Whether a bit of the statusword is set."""
        return bool((self.statusword or 0) & bit)

    def fault(self) -> str | None:
        """The drive's fault, by its emergency, its boot-up message or its statusword."""
        if self.emergency is not None:
            return protocol.fault_line(self.emergency)
        if self.rebooted:
            return (
                f"drive {self._node} restarted; check its supply, then zero the fin and start again"
            )
        if self.state in protocol.FAULT_STATES:
            return "drive is in fault but did not report which one; run: softfin rig check"
        return None

    def synchronise(self, now: float) -> None:
        """A SYNC is about to be sent."""
        self.counters["syncs without all answers"] += self.time > 0 and not self.new
        self.answered = 0
        self.sync_time = now

    def take(self, cob_id: int, data: bytes, now: float) -> str | None:
        """Decode one frame of the bus; frames of other nodes change nothing."""
        function = cob_id & 0x780
        node = cob_id & 0x7F
        if node != self._node or function not in _SIZES:
            return None
        if len(data) != _SIZES[function]:
            self.counters["malformed frames"] += 1
            return None
        if function == protocol.HEARTBEAT:
            self.heartbeat_time = now
            self.nmt = data[0] & 0x7F
            self.rebooted |= self.nmt == protocol.BOOT_UP
            return self.fault() if self.nmt == protocol.BOOT_UP else None
        if function == protocol.EMERGENCY:
            code = int.from_bytes(data[:2], "little")
            # The first names the cause; what follows from it must not hide it.
            self.emergency = None if code == 0 else self.emergency or code
            return protocol.fault_line(code) if code else None
        was_well = self.fault() is None
        which = protocol.TPDO.index(function)
        values = _SENT[which].unpack(data)
        if which == 0:
            self.statusword, self.position = values
            self.angle = self._units.angle(self.position)
            if not self.has(Bit.LIMIT):
                self.limited_since = None
            elif self.limited_since is None:
                self.limited_since = now
        elif which == 1:
            self.velocity = self._units.velocity(values[0])
            self.current = values[1] / 1000
        else:
            self.demand = self._units.angle(values[0])
        self.answered |= 1 << which
        if self.new:
            self.time = self.sync_time
        return self.fault() if which == 0 and was_well else None


class Handshake:
    """The hand-shake by which an EPOS2 takes a target; `patience` [s] is how long an answer may
    take.

    Bit 4 of the controlword rises with the target; the drive answers with bit 12 of the statusword;
    bit 4 falls, then bit 12 (maxon "EPOS2 Firmware Specification", rel5466). The newest target wins
    while another is on its way.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self.repeated = 0
        self.clear()

    def clear(self) -> None:
        """Forget everything: the drive was stopped, or is enabled anew."""
        self._is_raised = False
        self._since = 0.0
        self.waiting: Setpoint | None = None
        """The target to give to the drive as soon as it can take it."""
        self.current: Setpoint | None = None
        """The target that the drive has, or is being given."""
        self.unanswered = 0
        """Times in a row that the drive did not acknowledge the current target."""

    def step(self, acknowledged: bool, now: float) -> Setpoint | bool | None:
        """Return the next thing to send: a target to raise, True to lower bit 4, or None."""
        late = now - self._since > self._patience
        if self._is_raised:
            if not (acknowledged or late):
                return None
            self._is_raised = False
            self._since = now
            if acknowledged:
                self.unanswered = 0
            else:
                self.unanswered = self.unanswered + 1
                self.repeated = self.repeated + 1
                self.waiting = self.waiting or self.current
            return True
        if self.waiting is None or (acknowledged and not late):
            return None
        self._since = now
        if acknowledged:
            # A drive whose bit 12 does not fall takes no target: the lowering may have been lost.
            self.unanswered += 1
            return True
        self._is_raised = True
        self.current = self.waiting
        self.waiting = None
        return self.current


class Exchange:
    """One drive on one bus; `on_fault(line)` is called in the receiver's thread within milliseconds
    of a fault."""

    def __init__(
        self,
        bus: BusConfig,
        config: Epos2Config,
        clock: Clock = REAL,
        on_fault: Callable[[str], None] | None = None,
    ) -> None:
        self.config = config
        self.units = Units.of(config)
        self.clock = clock
        self.on_fault = on_fault
        self.connection = CanConnection(bus, config.node, self._take, self._report, clock)
        # Where a bus is reached by a network, its channel alone does not tell two computers apart.
        server = [bus.options[name] for name in ("host", "port") if name in bus.options]
        name = f"drive {config.node} on {self.connection.name}"
        self.device_lock = DeviceLock(name, bus.interface, *server, bus.channel, config.node)
        """Taken by `connect`, so that no second program uses the drive."""
        self.lock = clock.condition()
        """Guards all below; notified of every frame."""
        self.stopping = clock.lock()
        """Held while the motor is brought to rest after a stop."""
        self.powered = False
        """Whether the motor may have power: not confirmed otherwise since it was last enabled."""
        self.own_ids = protocol.host_cob_ids(config.host)
        """COB-IDs that nobody but this program sends."""
        self.beats_left = BEATS_AFTER_STOP
        """Heartbeats that a drive may still get that does not obey a stop."""
        self.waiting_stop: int | None = None
        """Generation whose stop a thread is about to finish; None if there is no such thread."""
        self.rest_failed = False
        """Whether a stop since the last power-up was not confirmed: later ones are brief."""
        self.generation = 0
        """Number of times that the motor was powered up: a stop belongs to one of them."""
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before the first frame."""
        self.status = DriveStatus(self.config.node, self.units)
        self.handshake = Handshake(PATIENCE_TICKS * self.config.sync_s)
        self.serial: int | None = None
        """Serial number of the drive; None if it does not report it, or was not connected."""
        self.foreign_ids: frozenset[int] = frozenset()
        """COB-IDs of the frames that others sent before we did."""
        self.notes: tuple[str, ...] = ()
        """Notes on how the drive is set up, each one line, since it was opened."""
        self.sync_id = protocol.SYNC
        """COB-ID of the SYNC that the drive answers."""
        self.trouble: str | None = None
        """The newest problem on the bus; it stays until the drive is connected again."""
        self.owned = False
        """Whether this drive is ours to command."""
        self.armed = False
        """Whether targets may be sent."""
        self.stopped = False
        """Whether it was stopped since it was last to be enabled: what began before a stop must not
        go on after it."""

    def sync_and_read(self, timeout: float = 0.003) -> DriveStatus:
        """Have the drive sample, wait for the answers [s]; the newest known where they do not all
        come."""
        with self.lock:
            self.status.synchronise(self.clock())
            self.attempt(self.sync_id, b"")
            self.lock.wait_for(lambda: self.status.new, timeout)
            self.carry_on()
            return self.status

    @property
    def is_off(self) -> bool:
        """Whether the drive has answered the last SYNC that its motor is off."""
        return bool(self.status.answered & 1) and self.status.state in protocol.UNPOWERED

    @property
    def obeys_stop(self) -> bool:
        """Whether the drive reports that it brakes, by itself or for us, or that its motor is
        off."""
        braking = (State.QUICK_STOP_ACTIVE, *protocol.FAULT_STATES)
        return self.is_off or self.status.state in braking

    def send_heartbeat(self) -> None:
        """Send our heartbeat: a drive that is enabled stops by itself `heartbeat_s` after the last
        one.

        A drive that does not obey a stop must do that, so it gets `BEATS_AFTER_STOP` more at most.
        """
        if self.stopped and self.powered and not self.obeys_stop:
            if self.beats_left <= 0:
                return
            self.beats_left -= 1
        self.attempt(protocol.HEARTBEAT + self.config.host, bytes([protocol.OPERATIONAL]))

    def attempt(self, cob_id: int, data: bytes) -> bool:
        """Send where a bus that fails is a complaint and no error; whether it took the frame."""
        try:
            self.connection.send(cob_id, data)
        except DeviceError as error:
            self.trouble = str(error)
            return False
        return True

    def order(self, word: int, counts: int | None = None) -> tuple[int, bytes]:
        """The frame of a controlword with a target; without one, where the drive is."""
        data = _WORD_AND_TARGET.pack(word, self.status.position if counts is None else counts)
        return protocol.RPDO[0] + self.config.node, data

    def insist(self, word: int, also_by_sdo: bool = False) -> bool:
        """Send a controlword by process data, and by SDO too if the node does not take those or
        `also_by_sdo`; return whether the bus took it."""
        is_sent = self.attempt(*self.order(word))
        if is_sent and self.status.nmt == protocol.OPERATIONAL and not also_by_sdo:
            return True
        if self.status.nmt == protocol.NODE_STOPPED:
            # A node that somebody has stopped answers neither.
            self.attempt(protocol.NMT, bytes([protocol.NMT_PRE_OPERATIONAL, self.config.node]))
        return (
            self.attempt(
                protocol.SDO_REQUEST + self.config.node, download(protocol.CONTROLWORD, word)
            )
            or is_sent
        )

    def brake(self) -> bool:
        """Quick stop at once, from any thread; nothing is enabled or moved after it. False where a
        send hangs."""
        locked = self.lock.acquire(timeout=LOCK_TIMEOUT_S)
        try:
            self.armed = False
            self.stopped = True
            self.handshake.clear()
            if self.owned:
                self.insist(protocol.QUICK_STOP)
        finally:
            if locked:
                self.lock.release()
        return locked

    def carry_on(self) -> None:
        """Carry the hand-shake on, as far as the newest statusword lets it."""
        if not self.armed or self.status.state is not State.OPERATION_ENABLED:
            # A drive that somebody else has stopped must not be started again by the next target.
            return
        step = self.handshake.step(self.status.has(Bit.ACKNOWLEDGED), self.clock())
        if isinstance(step, tuple):
            counts, rpm = step
            # A stop does not wait for a send that hangs: where one has gone past this one, the
            # target must not follow.
            if (
                self.attempt(protocol.RPDO[1] + self.config.node, _VELOCITY.pack(rpm))
                and self.armed
            ):
                self.attempt(*self.order(protocol.NEW_TARGET, counts))
        elif step:
            target = self.handshake.current
            self.attempt(*self.order(protocol.ENABLE_OPERATION, target[0] if target else None))

    def _take(self, cob_id: int, data: bytes) -> None:
        if self.owned and cob_id in self.own_ids:
            # The drive would take its heartbeats for ours, and this fin would keep moving after our
            # death. It may have been silent while we listened, for example to wait for a person.
            self._report(
                f"another program on {self.connection.name} uses this program's node number "
                f"{self.config.host}; end it, or give each rig's file its own drive.host_node"
            )
        with self.lock:
            fault = self.status.take(cob_id, data, self.clock())
            if fault and self.armed:
                # The drive may clear it before anybody looks, but it has stopped the motor.
                self.trouble = self.trouble or fault
            if cob_id == protocol.TPDO[0] + self.config.node:
                self.carry_on()
            self.lock.notify_all()
        if fault:
            self._tell(fault)

    def _report(self, line: str) -> None:
        self.trouble = line
        self._tell(line)

    def _tell(self, line: str) -> None:
        """Call `on_fault`; its errors must not end the receiver's thread, which also brings the
        answers to a stop."""
        try:
            if self.on_fault:
                self.on_fault(line)
        except Exception as error:
            self.trouble = f"{line} (and the reaction to it failed: {error})"
