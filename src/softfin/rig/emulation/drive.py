"""An emulated EPOS2 on any python-can bus, a fin that moves by itself behind it: the protocol of the real one.

It is made from the same documents as our driver of it, so that it shares what both misread; canopen's LocalNode
serves its objects. What a test wants to go wrong is a method: `fault`, `stall`, `go_silent`, `reboot` ..
"""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

import can
import canopen

from softfin.core.clock import REAL, Clock
from softfin.rig.emulation import drive_states
from softfin.rig.emulation.drive_dictionary import ERRORS_KEPT, dictionary, values
from softfin.rig.emulation.drive_motion import MODES, Motion
from softfin.rig.emulation.drive_network import NMT_RESET_COMMUNICATION, DriveNetwork
from softfin.rig.emulation.drive_pdo import OUT_OF_RANGE, ProcessData
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import BusConfig, DriveConfig, Units
from softfin.rig.epos2.objects import Object
from softfin.rig.simulated_bus import open_bus

TICK_S = 0.005
NO_SUCH_ENTRY = 0x06090011
_REGISTERS = ((0x2000, 0x02), (0x3000, 0x04), (0x4000, 0x08), (0x8600, 0x20), (0x8000, 0x10), (0xFF00, 0x80))
"""First code of each kind of error, and its bit of the error register; all set bit 0, too (CiA 301)."""


class EmulatedDrive:
    """Set up as `config` says a real one is; `start` it, `close` it."""

    def __init__(self, bus: BusConfig, config: DriveConfig, fin: EmulatedFin, clock: Clock = REAL) -> None:
        self._bus, self._config, self._clock = bus, config, clock
        self._lock = clock.lock()
        self._network = DriveNetwork(self._take, self._request, lambda: self._nmt_state, clock)
        self.counters = self._network.counters
        node: Any = canopen.LocalNode
        self._node = node(config.node, dictionary(values(config)))
        self._node.add_read_callback(self._live)
        self._node.add_write_callback(self._written)
        self._motion = Motion(fin, Units.of(config), self._value, self.fault)
        self._process_data = ProcessData(self._node, self._network.send_message, self.fault)
        self._readings: dict[int, Callable[[], int]] = {
            objects.STATUSWORD.number: lambda: self.statusword,
            objects.ERROR_REGISTER.number: lambda: self._register,
            objects.MODE_DISPLAY.number: lambda: self._motion.mode,
            objects.POSITION.number: lambda: self._motion.position,
            objects.DEMAND.number: self._demand,
            objects.VELOCITY.number: lambda: self._motion.rpm,
            objects.CURRENT.number: lambda: self._motion.current,
        }
        self.state = State.START
        self._errors: list[int] = []
        self._ending = clock.event()
        self._ticking: threading.Thread | None = None
        self._power_up()

    # -- life ---------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Power-up: boot-up message, then pre-operational and switched off."""
        self._network.receive(open_bus(self._bus, self._clock))
        self._network[self._config.node] = self._node
        self._boot()
        self._ticking = self._clock.spawn(self._run, "emulated drive")

    def close(self) -> None:
        """Power-down; any number of times."""
        self._ending.set()
        if self._ticking:
            self._ticking.join(1.0)
            self._ticking = None
        self._motion.halt()
        self._node.nmt.stop_heartbeat()
        self._network.disconnect()

    def __enter__(self) -> "EmulatedDrive":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def remembered(self) -> dict[str, Any]:
        """What it would lose with its supply: its zero, for JSON."""
        return {"zero_counts": self._motion.zero, "referenced": self._motion.referenced}

    def recall(self, remembered: dict[str, Any]) -> None:
        """As if its supply had never been off."""
        self._motion.zero, self._motion.referenced = int(remembered["zero_counts"]), bool(remembered["referenced"])

    # -- what can go wrong --------------------------------------------------------------------------------------------

    def fault(self, code: int) -> None:
        """Emergency frame, error history, fault reaction."""
        with self._lock:
            if self.state in cia402.FAULTS:
                return
            self._enter(drive_states.to_fault(self.state))
            self._register = _register(code)
            self._errors = [code, *self._errors][:ERRORS_KEPT]
            self._emergency(code, self._register)

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
            self._power_up()
            self._boot()

    def stall(self) -> None:
        """The fin is blocked: it stays where it is while the profile goes on."""
        with self._lock:
            self._motion.stall()

    def ignore_targets(self, count: int) -> None:
        """Take none of the next targets, as if their frames were lost."""
        self._motion.ignored = count

    # -- state --------------------------------------------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        """As it would be sent now."""
        with self._lock:
            motion, reaches = self._motion, self.state in {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE}
            bits = {
                Bit.REMOTE: self._is_operational,
                Bit.TARGET_REACHED: reaches and motion.is_target_reached,
                Bit.ACKNOWLEDGED: motion.is_acknowledged,
                Bit.ERROR: self._is_behind(),
                Bit.REFERENCED: motion.referenced,
            }
            return int(self.state.value) | sum(bit for bit, is_set in bits.items() if is_set)

    @property
    def _nmt_state(self) -> str:
        state: str = self._node.nmt.state
        return state

    @property
    def _is_operational(self) -> bool:
        return self._nmt_state == "OPERATIONAL"

    def _power_up(self) -> None:
        self.state = State.START
        self._motion.power_up()
        self._word = self._register = 0
        self._errors = []
        self._host_beat: float | None = None
        self._node.data_store.clear()

    def _reset_communication(self) -> None:
        for index in [index for index in self._node.data_store if index < 0x2000]:
            del self._node.data_store[index]
        self._host_beat = None
        self._boot()

    def _boot(self) -> None:
        self._node.nmt.stop_heartbeat()
        self._process_data.restart()
        for code in (objects.NMT_RESET, objects.NMT_PRE_OPERATIONAL):
            self._node.nmt.send_command(code)

    def _demand(self) -> int:
        return self._motion.demand if self.state is State.OPERATION_ENABLED else self._motion.position

    def _is_behind(self) -> bool:
        return abs(self._demand() - self._motion.position) > self._value(objects.FOLLOWING_ERROR)

    def _value(self, entry: Object) -> int:
        value: int = entry.layout.unpack(self._node.get_data(entry.number, entry.sub))[0]
        return value

    # -- objects ------------------------------------------------------------------------------------------------------

    def _live(self, index: int, subindex: int, od: Any) -> int | None:
        if subindex != od.subindex:
            # canopen lets every sub-index of an object without any pass.
            raise canopen.SdoAbortedError(NO_SUCH_ENTRY)
        read = self._readings.get(index)
        if read is None and index != objects.ERROR_COUNT.number:
            return None
        with self._lock:
            if read is not None:
                return read()
            return len(self._errors) if subindex == 0 else [*self._errors, *[0] * ERRORS_KEPT][subindex - 1]

    def _written(self, index: int, subindex: int, od: Any, data: bytes | bytearray) -> None:
        if subindex != od.subindex:
            raise canopen.SdoAbortedError(NO_SUCH_ENTRY)
        with self._lock:
            if index == objects.CONTROLWORD.number:
                self._controlled(objects.CONTROLWORD.layout.unpack(data)[0])
            elif index == objects.MODE.number:
                mode = objects.MODE.layout.unpack(data)[0]
                if mode not in MODES:
                    raise canopen.SdoAbortedError(OUT_OF_RANGE)
                self._motion.mode = mode
            elif index == objects.HEARTBEAT_CONSUMER.number:
                # Watching begins with the first heartbeat after this (CiA 301).
                self._host_beat = None
            elif index == objects.ERROR_COUNT.number:
                if any(data):
                    raise canopen.SdoAbortedError(OUT_OF_RANGE)
                self._errors = []
            elif 0x1400 <= index < 0x1C00:
                self._process_data.check(index, subindex, data)

    # -- motion -------------------------------------------------------------------------------------------------------

    def _controlled(self, word: int) -> None:
        before, self._word = self._word, word
        was = self.state
        self._enter(drive_states.by_controlword(was, word, before))
        if was is State.FAULT and self.state is not State.FAULT:
            self._register = 0
            self._emergency(0, 0)
        if self.state is State.OPERATION_ENABLED:
            self._motion.control(word, before)

    def _enter(self, state: State) -> None:
        before, self.state = self.state, state
        if before is not state and before in cia402.POWERED:
            self._motion.halt()

    def _run(self) -> None:
        while not self._ending.wait(TICK_S):
            with self._lock, contextlib.suppress(can.CanError):
                self._enter(drive_states.by_itself(self.state))
                if self.state is State.OPERATION_ENABLED:
                    self._motion.tick()
                    if self._is_behind():
                        self.fault(0x8611)
                self._watch_host()
                if self._is_operational:
                    self._process_data.send_events()

    def _watch_host(self) -> None:
        silence = self._value(objects.HEARTBEAT_CONSUMER) & 0xFFFF
        if silence and self._host_beat is not None and self._clock() - self._host_beat > silence / 1000:
            self._host_beat = None
            self.fault(0x8130)

    # -- frames -------------------------------------------------------------------------------------------------------

    def _take(self, cob_id: int, data: bytes) -> None:
        """One frame; canopen has answered it already where it is an SDO, and followed it where it is an NMT command."""
        with self._lock:
            if cob_id == objects.NMT:
                self._follow_nmt(data[0])
            elif cob_id & 0x780 == objects.HEARTBEAT:
                if cob_id & 0x7F == self._value(objects.HEARTBEAT_CONSUMER) >> 16 & 0x7F:
                    self._host_beat = self._clock()
            elif self._is_operational and cob_id == objects.SYNC:
                self._process_data.synchronise()
            elif self._is_operational:
                self._process_data.take(cob_id, data)

    def _follow_nmt(self, command: int) -> None:
        if self._nmt_state == "INITIALISING":
            if command == NMT_RESET_COMMUNICATION:
                self._reset_communication()
            else:
                self.reboot()
        elif not self._is_operational:
            self._process_data.restart()

    def _request(self, cob_id: int) -> None:
        with self._lock:
            if self._is_operational:
                self._process_data.request(cob_id)

    def _emergency(self, code: int, register: int) -> None:
        if self._nmt_state == "STOPPED":
            return
        with contextlib.suppress(can.CanError, RuntimeError):
            self._node.emcy.send(code, register, bytes(5))


def _register(code: int) -> int:
    for first, bit in _REGISTERS:
        if code >= first and code & 0xF000 == first & 0xF000:
            return 0x01 | bit
    return 0x01
