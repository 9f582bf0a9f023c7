"""An emulated EPOS2 on any python-can bus, a fin that moves by itself behind it: the protocol of the real one.

It is made from the same documents as our driver of it, so that it shares what both misread; canopen's LocalNode
serves its objects. What a test wants to go wrong is a method: `fault`, `stall`, `go_silent`, `reboot` ..
"""

import contextlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import can
import canopen

from softfin.rig import cia402
from softfin.rig import epos2_objects as objects
from softfin.rig.cia402 import Bit, State
from softfin.rig.emulation import drive_states
from softfin.rig.emulation.drive_dictionary import ERRORS_KEPT, MAPPED, PDOS, dictionary, values
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.epos2_config import BusConfig, DriveConfig, Units
from softfin.rig.epos2_objects import Object

TICK_S = 0.005
SDO_LENGTH = 8
NEW_TARGET_BIT, RELATIVE_BIT, HALT_BIT = 0x10, 0x40, 0x100
MODES = frozenset({objects.PROFILE_POSITION, objects.HOMING, 3, -1, -2, -3})
OUT_OF_RANGE, WRONG_STATE = 0x06090030, 0x08000022
GENERIC_ERROR, COMMUNICATION_ERROR = 0x01, 0x11
_HALTING = frozenset(
    {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON}
)
"""States that are entered with the fin at rest."""


class EmulatedDrive:
    """Set up as `config` says a real one is; `start` it, `close` it."""

    def __init__(
        self, bus: BusConfig, config: DriveConfig, fin: EmulatedFin, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._bus, self._config, self._fin, self._clock = bus, config, fin, clock
        self._units = Units.of(config)
        self._lock = threading.RLock()
        self._network = _Network(self)
        node: Any = canopen.LocalNode
        self._node = node(config.node, dictionary(values(config)))
        self._node.add_read_callback(self._live)
        self._node.add_write_callback(self._written)
        self.state = State.START
        self._errors: list[int] = []
        self._register = 0
        self._stalled_at: int | None = None
        self._ending = threading.Event()
        self._ticking: threading.Thread | None = None
        self.counters: Counter[str] = Counter()
        self._ignored = 0
        self._power_up()

    # -- life ---------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Power-up: boot-up message, then pre-operational and switched off."""
        options: dict[str, Any] = {**self._bus.options, "bitrate": self._bus.bitrate}
        self._network.bus = can.Bus(interface=self._bus.interface, channel=self._bus.channel, **options)
        self._network.NOTIFIER_CYCLE = 0.05
        self._network.connect()
        self._network[self._config.node] = self._node
        self._boot()
        self._ticking = threading.Thread(target=self._run, name="emulated drive", daemon=True)
        self._ticking.start()

    def close(self) -> None:
        """Power-down; any number of times."""
        self._ending.set()
        if self._ticking:
            self._ticking.join(1.0)
            self._ticking = None
        self._fin.halt()
        self._node.nmt.stop_heartbeat()
        if self._network.bus:
            self._network.disconnect()

    def __enter__(self) -> "EmulatedDrive":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- what can go wrong --------------------------------------------------------------------------------------------

    def fault(self, code: int) -> None:
        """Emergency frame, error history, fault reaction."""
        with self._lock:
            if self.state in cia402.FAULTS:
                return
            self.state = drive_states.to_fault(self.state)
            self._fin.halt()
            register = GENERIC_ERROR if code & 0xF000 != 0x8000 else COMMUNICATION_ERROR
            self._register = register
            self._errors = [code, *self._errors][:ERRORS_KEPT]
            self._emergency(code, register)

    def drop_heartbeat(self) -> None:
        """No more heartbeats; all else goes on."""
        self._node.nmt.stop_heartbeat()

    def go_silent(self) -> None:
        """The cable is cut: nothing comes in and nothing goes out, the drive goes on by itself."""
        self._network.silent = True
        self._node.nmt.stop_heartbeat()

    def bus_off(self) -> None:
        """The drive's CAN controller has given up: silent, and in fault."""
        self.go_silent()
        self.fault(0x81FD)

    def reboot(self) -> None:
        """The supply failed for a moment: the zero is lost."""
        with self._lock:
            self._fin.halt()
            self._power_up()
            self._boot()

    def stall(self) -> None:
        """The fin is blocked: it stays where it is while the profile goes on."""
        with self._lock:
            self._stalled_at = self._counts()

    def ignore_targets(self, count: int) -> None:
        """Take none of the next targets, as if their frames were lost."""
        self._ignored = count

    # -- state --------------------------------------------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        """As it would be sent now."""
        with self._lock:
            motion = self._fin.now()
            there = motion.velocity == 0 and self.state is State.OPERATION_ENABLED
            bits = {
                Bit.REMOTE: self._node.nmt.state == "OPERATIONAL",
                Bit.TARGET_REACHED: there,
                Bit.ACKNOWLEDGED: self._acknowledged,
                Bit.ERROR: self._behind() > self._value(objects.FOLLOWING_ERROR),
                Bit.REFERENCED: self._referenced,
            }
            return int(self.state.value) | sum(bit for bit, is_set in bits.items() if is_set)

    def _power_up(self) -> None:
        self.state = State.START
        self._word = 0
        self._mode = objects.PROFILE_POSITION
        self._acknowledged = self._referenced = False
        self._errors, self._register, self._stalled_at = [], 0, None
        self._host_beat: float | None = None
        self._zero = 0
        # An incremental encoder counts from wherever it wakes up.
        self._zero = self._counts()
        self._node.data_store.clear()

    def _boot(self) -> None:
        self._node.nmt.stop_heartbeat()
        for code in (objects.NMT_RESET, objects.NMT_PRE_OPERATIONAL):
            self._node.nmt.send_command(code)

    def _counts(self) -> int:
        return self._units.counts(self._fin.now().angle) - self._zero

    def _position(self) -> int:
        return self._counts() if self._stalled_at is None else self._stalled_at

    def _demand(self) -> int:
        if self.state is not State.OPERATION_ENABLED:
            return self._position()
        return self._units.counts(self._fin.now().demand) - self._zero

    def _behind(self) -> int:
        return abs(self._demand() - self._position())

    def _value(self, entry: Object) -> int:
        value: int = entry.layout.unpack(self._node.get_data(entry.number, entry.sub))[0]
        return value

    # -- objects ------------------------------------------------------------------------------------------------------

    def _live(self, index: int, subindex: int, **_: object) -> int | None:
        with self._lock:
            if index == objects.ERROR_COUNT.number:
                return len(self._errors) if subindex == 0 else [*self._errors, *[0] * ERRORS_KEPT][subindex - 1]
            moving = 0.0 if self._stalled_at is not None else self._fin.now().velocity
            live: dict[int, Callable[[], int]] = {
                objects.STATUSWORD.number: lambda: self.statusword,
                objects.ERROR_REGISTER.number: lambda: self._register,
                objects.MODE_DISPLAY.number: lambda: self._mode,
                objects.POSITION.number: self._position,
                objects.DEMAND.number: self._demand,
                objects.VELOCITY.number: lambda: self._units.signed_rpm(moving),
                objects.CURRENT.number: lambda: _clip(round(1000 * self._fin.now().current), 0x7FFF),
            }
            return live[index]() if index in live else None

    def _written(self, index: int, subindex: int, data: bytes | bytearray, **_: object) -> None:
        with self._lock:
            if index == objects.CONTROLWORD.number:
                self._controlled(objects.CONTROLWORD.layout.unpack(data)[0])
            elif index == objects.MODE.number:
                self._set_mode(objects.MODE.layout.unpack(data)[0])
            elif index == objects.HEARTBEAT_CONSUMER.number:
                # Watching begins with the first heartbeat after this (CiA 301).
                self._host_beat = None
            elif index == objects.ERROR_COUNT.number:
                self._clear_errors(data)
            elif 0x1400 <= index < 0x1C00:
                self._refuse_mapping(index, subindex)

    def _set_mode(self, mode: int) -> None:
        if mode not in MODES:
            raise canopen.SdoAbortedError(OUT_OF_RANGE)
        self._mode = mode
        self._acknowledged = False

    def _clear_errors(self, data: bytes | bytearray) -> None:
        if any(data):
            raise canopen.SdoAbortedError(OUT_OF_RANGE)
        self._errors = []

    def _refuse_mapping(self, index: int, subindex: int) -> None:
        """A PDO is mapped while it is off, its entries while their number is zero, none while operational."""
        is_mapping = bool(index & 0x200)
        if subindex == 1 and not is_mapping:
            return
        running = self._node.nmt.state == "OPERATIONAL"
        on = not self._value(Object(index & ~0x200, 1, "I", "COB-ID")) & objects.INVALID
        counted = is_mapping and subindex > 0 and self._value(Object(index, 0, "B", "mapped objects")) > 0
        if on or running or counted:
            raise canopen.SdoAbortedError(WRONG_STATE)

    # -- motion -------------------------------------------------------------------------------------------------------

    def _controlled(self, word: int) -> None:
        before, self._word = self._word, word
        was = self.state
        self._enter(drive_states.by_controlword(was, word, before))
        if was is State.FAULT and self.state is not State.FAULT:
            self._register = 0
            self._emergency(0, 0)
        if not word & NEW_TARGET_BIT and self._mode == objects.PROFILE_POSITION:
            self._acknowledged = False
        if self.state is State.OPERATION_ENABLED:
            if word & HALT_BIT:
                self._fin.halt()
            elif word & ~before & NEW_TARGET_BIT:
                self._start_motion(relative=bool(word & RELATIVE_BIT))

    def _enter(self, state: State) -> None:
        changed, self.state = state is not self.state, state
        if changed and state in _HALTING:
            self._fin.halt()

    def _start_motion(self, relative: bool) -> None:
        if self._mode == objects.HOMING:
            if self._value(Object(0x6098, 0, "b", "homing method")) == objects.HOME_HERE:
                self._zero += self._counts()
                self._referenced = self._acknowledged = True
        elif self._mode == objects.PROFILE_POSITION:
            if self._ignored:
                self._ignored -= 1
                return
            self._acknowledged = True
            self._move(self._value(objects.TARGET) + (self._position() if relative else 0))

    def _move(self, counts: int) -> None:
        if not self._value(objects.POSITION_MIN) <= counts <= self._value(objects.POSITION_MAX):
            self.fault(0xFF09)
            return
        rpm = min(self._value(objects.PROFILE_VELOCITY), self._value(objects.FASTEST))
        self._fin.move(self._units.angle(counts + self._zero), abs(self._units.velocity(rpm)))

    def _run(self) -> None:
        while not self._ending.wait(TICK_S):
            with self._lock, contextlib.suppress(can.CanError):
                self._enter(drive_states.by_itself(self.state))
                if self.state is State.OPERATION_ENABLED and self._behind() > self._value(objects.FOLLOWING_ERROR):
                    self.fault(0x8611)
                self._watch_host()

    def _watch_host(self) -> None:
        silence = self._value(objects.HEARTBEAT_CONSUMER) & 0xFFFF
        if silence and self._host_beat is not None and self._clock() - self._host_beat > silence / 1000:
            self._host_beat = None
            self.fault(0x8130)

    # -- frames -------------------------------------------------------------------------------------------------------

    def take(self, cob_id: int, data: bytes) -> None:
        """One frame that is no SDO and no NMT command."""
        with self._lock:
            operational = self._node.nmt.state == "OPERATIONAL"
            if cob_id == objects.NMT and self._node.nmt.state == "INITIALISING":
                self.reboot()
            elif cob_id == objects.SYNC and operational:
                self._answer_sync()
            elif cob_id == objects.HEARTBEAT + (self._value(objects.HEARTBEAT_CONSUMER) >> 16 & 0x7F):
                self._host_beat = self._clock()
            elif operational:
                self._process_data(cob_id, data)

    def _answer_sync(self) -> None:
        for number in range(PDOS):
            cob_id, transmission, mapped = self._mapped(0x1800 + number)
            if not cob_id & objects.INVALID and transmission <= 240:
                data = b"".join(self._node.get_data(index, sub) for index, sub, _ in mapped)
                self._network.send_message(cob_id & 0x7FF, data)

    def _process_data(self, cob_id: int, data: bytes) -> None:
        for number in range(PDOS):
            own, _, mapped = self._mapped(0x1400 + number)
            if own & objects.INVALID or own & 0x7FF != cob_id:
                continue
            if len(data) < sum(size for _, _, size in mapped):
                self.fault(0x8210)
                return
            parts = []
            for index, sub, size in mapped:
                parts.append((index, sub, data[:size]))
                data = data[size:]
            # One frame holds at one moment: what it orders comes after what it sets.
            for part in sorted(parts, key=lambda part: part[0] == objects.CONTROLWORD.number):
                self._node.set_data(*part)

    def _mapped(self, number: int) -> tuple[int, int, list[tuple[int, int, int]]]:
        cob_id = self._value(Object(number, 1, "I", "COB-ID"))
        transmission = self._value(Object(number, 2, "B", "transmission type"))
        count = min(MAPPED, self._value(Object(number + 0x200, 0, "B", "mapped objects")))
        entries = [self._value(Object(number + 0x200, 1 + place, "I", "mapping")) for place in range(count)]
        return cob_id, transmission, [(each >> 16, each >> 8 & 0xFF, (each & 0xFF) // 8) for each in entries]

    def _emergency(self, code: int, register: int) -> None:
        with contextlib.suppress(can.CanError, RuntimeError):
            self._node.emcy.send(code, register, bytes(5))


class _Network(canopen.Network):
    """canopen's, but for a cable that can be cut, and a receiver that no frame can end."""

    def __init__(self, drive: EmulatedDrive) -> None:
        super().__init__()
        self._drive = drive
        self.silent = False

    def send_message(self, can_id: int, data: bytes | bytearray | list[int], remote: bool = False) -> None:
        if not self.silent and self.bus is not None:
            super().send_message(can_id, bytes(data), remote)

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if self.silent:
            return
        if can_id & 0x780 == objects.SDO_REQUEST and len(data) != SDO_LENGTH:
            # canopen's server would print a traceback for it.
            self._drive.counters["refused frames"] += 1
            return
        try:
            super().notify(can_id, data, timestamp)
            self._drive.take(can_id, bytes(data))
        except Exception:
            # Whatever canopen makes of a frame that makes no sense.
            self._drive.counters["refused frames"] += 1


def _clip(value: int, largest: int) -> int:
    return int(math.copysign(min(abs(value), largest), value))
