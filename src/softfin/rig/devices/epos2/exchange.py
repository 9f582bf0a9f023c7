"""Communication between host and drive: SYNC, process data, heartbeats, new targets and quick stop.

The receiver thread processes received frames; the thread of the caller sends frames. Frames that
could move the fin are sent only while the lock is held and `armed` is set, so that no such frame
can follow a stop.
"""

from collections import Counter
from collections.abc import Callable
from typing import TypeAlias

from softfin.core.errors import DeviceError
from softfin.rig.bus import BusConfig
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Epos2Config, Units
from softfin.rig.devices.epos2.connection import CanConnection, download
from softfin.rig.devices.epos2.protocol import Bit, State
from softfin.rig.lock import DeviceLock

PATIENCE_TICKS = 6
"""Number of ticks within which the drive must acknowledge a target; it sends one statusword per
tick."""
BEATS_AFTER_STOP = 3
"""Number of heartbeats sent after a stop that the drive does not obey, because an answer may be a
few ticks late."""
LOCK_TIMEOUT_S = 0.05
"""Maximum wait of a stop for the lock [s]; a thread that hangs while sending must not block a
stop."""

_SENT = tuple(protocol.layout(each) for each in protocol.SENT)
_WORD_AND_TARGET, _VELOCITY = (protocol.layout(each) for each in protocol.TAKEN)
_SIZES = {protocol.HEARTBEAT: 1, protocol.EMERGENCY: 8}
_SIZES |= {pdo: each.size for pdo, each in zip(protocol.TPDO, _SENT, strict=True)}
"""Length of each type of frame [bytes]."""
ALL = (1 << len(_SENT)) - 1

Setpoint: TypeAlias = tuple[int, int]
"""A target in drive units: position [counts] and velocity [rpm]."""


class DriveStatus:
    """Latest values from the drive; `take` returns a message if a frame reports a fault."""

    def __init__(self, node: int, units: Units) -> None:
        self._node = node
        self._units = units
        self.statusword: int | None = None
        self.position = 0
        """Position [counts]."""
        self.angle = self.demand = units.angle(0)
        """Fin angle, and angle demanded by the drive [rad]."""
        self.velocity = 0.0
        """Fin angular velocity [rad/s]."""
        self.current = 0.0
        """Motor current [A], positive in the positive direction of the fin."""
        self.answered = 0
        """One bit per TPDO received since the last SYNC."""
        self.sync_time = 0.0
        """Time of the last SYNC, at which the drive samples its values [s]."""
        self.time = 0.0
        """Time of the last SYNC after which all TPDOs were received [s]; no value is older."""
        self.heartbeat_time = 0.0
        self.nmt: int | None = None
        self.emergency: int | None = None
        self.rebooted = False
        self.limited_since: float | None = None
        """Time at which the drive started to report an active internal limit [s]; None if no limit
        is active."""
        self.counters: Counter[str] = Counter()

    @property
    def state(self) -> State | None:
        """State in the latest statusword; None before the first statusword and for an unknown
        state."""
        return None if self.statusword is None else protocol.decode(self.statusword)

    @property
    def new(self) -> bool:
        """Whether all TPDOs for the last SYNC have been received."""
        return self.answered == ALL

    @property
    def words(self) -> str:
        """Name of the state for messages."""
        return protocol.describe_state(self.state, self.statusword or 0)

    def has(self, bit: Bit) -> bool:
        """Return whether a bit of the statusword is set."""
        return bool((self.statusword or 0) & bit)

    def fault(self) -> str | None:
        """Return the fault of the drive according to its emergency message, boot-up message or
        statusword."""
        if self.emergency is not None:
            return protocol.fault_line(self.emergency)
        if self.rebooted:
            return (
                f"drive {self._node} restarted; check its supply, then zero the fin and start again"
            )
        if self.state in protocol.FAULT_STATES:
            return "drive is in fault but did not report the cause; run: softfin rig check"
        return None

    def synchronise(self, now: float) -> None:
        """Reset the answers before a SYNC is sent at time `now` [s]."""
        # Counting starts after the first complete set of answers, because the node may not be
        # operational before.
        self.counters["syncs without all answers"] += self.time > 0 and not self.new
        self.answered = 0
        self.sync_time = now

    def take(self, cob_id: int, data: bytes, now: float) -> str | None:
        """Decode one frame; frames from other nodes are ignored. Return a message if the frame
        reports a new fault."""
        # CiA 301: bits 7 to 10 are the function code, bits 0 to 6 the node number.
        function = cob_id & 0x780
        node = cob_id & 0x7F
        if node != self._node or function not in _SIZES:
            return None
        if len(data) != _SIZES[function]:
            self.counters["malformed frames"] += 1
            return None
        if function == protocol.HEARTBEAT:
            return self._take_heartbeat(data, now)
        if function == protocol.EMERGENCY:
            return self._take_emergency(data)
        return self._take_process_data(protocol.TPDO.index(function), data, now)

    def _take_heartbeat(self, data: bytes, now: float) -> str | None:
        self.heartbeat_time = now
        # Bit 7 is not part of the state (CiA 301).
        self.nmt = data[0] & 0x7F
        if self.nmt != protocol.BOOT_UP:
            return None
        self.rebooted = True
        return self.fault()

    def _take_emergency(self, data: bytes) -> str | None:
        code = int.from_bytes(data[:2], "little")
        # Keep the first code, which is the cause and must not be hidden by subsequent errors.
        self.emergency = None if code == 0 else self.emergency or code
        return protocol.fault_line(code) if code else None

    def _take_process_data(self, which: int, data: bytes, now: float) -> str | None:
        had_fault = self.fault() is not None
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
            # The drive sends the current in mA, positive in its own positive direction.
            self.current = self._units.direction * values[1] / 1000
        else:
            self.demand = self._units.angle(values[0])
        self.answered |= 1 << which
        if self.new:
            self.time = self.sync_time
        # Only TPDO 1 contains the statusword.
        return self.fault() if which == 0 and not had_fault else None


class Handshake:
    """The handshake for new targets of an EPOS2; `patience` is the maximum wait for an answer [s].

    The host sets bit 4 of the controlword with the target; the drive sets bit 12 of the statusword;
    the host clears bit 4 and the drive clears bit 12 (maxon "EPOS2 Firmware Specification",
    rel5466). A target that arrives during a handshake waits until the end of the handshake; a newer
    target replaces it.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self.repeated = 0
        self.clear()

    def clear(self) -> None:
        """Reset the handshake after a stop or before the drive is enabled again."""
        self._is_raised = False
        self._since = 0.0
        self.waiting: Setpoint | None = None
        """Next target, sent as soon as the drive can accept it."""
        self.current: Setpoint | None = None
        """Target that the drive has or is receiving."""
        self.unanswered = 0
        """Number of consecutive targets that the drive did not acknowledge."""

    def step(self, acknowledged: bool, now: float) -> Setpoint | bool | None:
        """Return the next transmission: a target (sets bit 4), True (clears bit 4), or None."""
        late = now - self._since > self._patience
        if self._is_raised:
            if not (acknowledged or late):
                return None
            self._is_raised = False
            self._since = now
            if acknowledged:
                self.unanswered = 0
            else:
                self.unanswered += 1
                self.repeated += 1
                # Send the unacknowledged target again unless there is a newer target.
                self.waiting = self.waiting or self.current
            return True
        if self.waiting is None or (acknowledged and not late):
            return None
        self._since = now
        if acknowledged:
            # The drive accepts no target while bit 12 is set; the frame that clears bit 4 may have
            # been lost.
            self.unanswered += 1
            return True
        self._is_raised = True
        self.current = self.waiting
        self.waiting = None
        return self.current


class Exchange:
    """One drive on one bus; `on_fault(line)` is called from the receiver thread within milliseconds
    of a fault."""

    def __init__(
        self,
        bus: BusConfig,
        config: Epos2Config,
        clock: Computer = COMPUTER,
        on_fault: Callable[[str], None] | None = None,
    ) -> None:
        self.bus = bus
        self.config = config
        self._ticks = 0
        """Number of readings so far."""
        self.units = Units.of(config)
        self.clock = clock
        self.on_fault = on_fault
        self.connection = CanConnection(bus, config.node, self._take, self._report, clock)
        # If the bus is on a network, the channel alone does not identify the computer.
        server = [bus.options[name] for name in ("host", "port") if name in bus.options]
        name = f"drive {config.node} on {self.connection.name}"
        self.device_lock = DeviceLock(name, bus.interface, *server, bus.channel, config.node)
        """Lock acquired by `connect` so that no second program uses the drive."""
        self.lock = clock.condition()
        """Protects the attributes below; notified after every frame."""
        self.stopping = clock.lock()
        """Lock held while a stop brings the motor to rest."""
        self.powered = False
        """Whether the motor may be powered; False only after the drive has confirmed that the motor
        is off."""
        self.own_ids = protocol.host_cob_ids(config.host)
        """COB-IDs reserved for this program."""
        self.beats_left = BEATS_AFTER_STOP
        """Number of heartbeats still allowed for a drive that does not obey a stop."""
        self.waiting_stop: int | None = None
        """Generation whose stop is being completed by a separate thread; None if there is no such
        thread."""
        self.rest_failed = False
        """Whether a stop since the last power-up was not confirmed; later stops are then brief."""
        self.generation = 0
        """Number of power-ups of the motor; each stop belongs to one power-up."""
        self.reset()

    def reset(self) -> None:
        """Reset the state to its values before the first frame."""
        self.status = DriveStatus(self.config.node, self.units)
        self.handshake = Handshake(PATIENCE_TICKS * self.config.sync_s)
        self.serial: int | None = None
        """Serial number of the drive; None if the drive does not report it or has not been
        connected."""
        self.foreign_ids: frozenset[int] = frozenset()
        """COB-IDs of the frames received before we sent anything."""
        self.notes: tuple[str, ...] = ()
        """Notes on the drive setup since the drive was opened, one line each."""
        self.sync_id = protocol.SYNC
        """COB-ID of the SYNC to which the drive responds."""
        self.trouble: str | None = None
        """Latest problem on the bus, kept until the drive is connected again."""
        self.owned = False
        """Whether this program controls the drive."""
        self.armed = False
        """Whether targets may be sent."""
        self.stopped = False
        """Whether the drive has been stopped since enabling started; an action from before a stop
        must not continue after it."""

    def sync_and_read(self, timeout: float = 0.003) -> DriveStatus:
        """Send a SYNC and wait up to `timeout` [s] for the answers; return the status, which keeps
        older values if answers are missing."""
        with self.lock:
            self.status.synchronise(self.clock())
            self.attempt(self.sync_id, b"")
            self.lock.wait_for(lambda: self.status.new, timeout)
            self.carry_on()
            return self.status

    @property
    def is_off(self) -> bool:
        """Whether the answer of the drive to the last SYNC reports that the motor is off."""
        return bool(self.status.answered & 1) and self.status.state in protocol.UNPOWERED

    @property
    def obeys_stop(self) -> bool:
        """Whether the drive reports that it is braking, for any reason, or that its motor is
        off."""
        braking = (State.QUICK_STOP_ACTIVE, *protocol.FAULT_STATES)
        return self.is_off or self.status.state in braking

    def send_heartbeat(self) -> None:
        """Send a heartbeat; an enabled drive stops by itself `heartbeat_s` after the last
        heartbeat.

        A drive that does not obey a stop must stop in this way, so it receives at most
        `BEATS_AFTER_STOP` more heartbeats.
        """
        if self.stopped and self.powered and not self.obeys_stop:
            if self.beats_left <= 0:
                return
            self.beats_left -= 1
        self.attempt(protocol.HEARTBEAT + self.config.host, bytes([protocol.OPERATIONAL]))

    def attempt(self, cob_id: int, data: bytes) -> bool:
        """Send a frame, recording a failure in `trouble` instead of raising; return whether the bus
        accepted it."""
        try:
            self.connection.send(cob_id, data)
        except DeviceError as error:
            self.trouble = str(error)
            return False
        return True

    def order(self, word: int, counts: int | None = None) -> tuple[int, bytes]:
        """Return the frame for a controlword with a target [counts]; the default target is the
        current position."""
        data = _WORD_AND_TARGET.pack(word, self.status.position if counts is None else counts)
        return protocol.RPDO[0] + self.config.node, data

    def insist(self, word: int, also_by_sdo: bool = False) -> bool:
        """Send a controlword as process data, and also over SDO if the node is not operational or
        `also_by_sdo` is set; return whether the bus accepted the frame."""
        is_sent = self.attempt(*self.order(word))
        if is_sent and self.status.nmt == protocol.OPERATIONAL and not also_by_sdo:
            return True
        if self.status.nmt == protocol.NODE_STOPPED:
            # A node in the NMT state "stopped" accepts neither process data nor SDO.
            self.attempt(protocol.NMT, bytes([protocol.NMT_PRE_OPERATIONAL, self.config.node]))
        return (
            self.attempt(
                protocol.SDO_REQUEST + self.config.node, download(protocol.CONTROLWORD, word)
            )
            or is_sent
        )

    def brake(self) -> bool:
        """Quick-stop immediately, from any thread; nothing is enabled or moved afterwards. Return
        False if a different thread hangs while sending."""
        # If the lock is not available in time, continue without it, because the stop must be sent
        # in any case.
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
        """Advance the handshake as far as the latest statusword permits; the caller holds the
        lock."""
        if not self.armed or self.status.state is not State.OPERATION_ENABLED:
            # If the drive was stopped by something else, the next target must not restart it.
            return
        step = self.handshake.step(self.status.has(Bit.ACKNOWLEDGED), self.clock())
        if isinstance(step, tuple):
            counts, rpm = step
            # A stop does not wait for a thread that hangs while sending, so it may have overtaken
            # this thread: check `armed` again before sending the target.
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
            # The drive would mistake the heartbeats of the other program for ours, and the fin
            # would keep moving if this program died. The other program may have been silent while
            # we listened, e.g. because it was waiting for user input.
            self._report(
                f"another program on {self.connection.name} uses the node number of this program, "
                f"{self.config.host}; close it, or set a different drive.host_node in each rig file"
            )
        with self.lock:
            fault = self.status.take(cob_id, data, self.clock())
            if fault and self.armed:
                # The drive may clear the fault before `complaints` is called, but the motor has
                # stopped.
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
        """Call `on_fault`; its errors must not end the receiver thread, which also receives the
        answers to a stop."""
        try:
            if self.on_fault:
                self.on_fault(line)
        except Exception as error:
            self.trouble = f"{line} (and the reaction to it failed: {error})"
