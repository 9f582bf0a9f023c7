"""An emulated EPOS2 on any python-can bus. It uses the protocol of a real drive and moves an
emulated fin.

It was written from the same documents as our driver, so it shares any misreading of them. canopen's
LocalNode serves its objects. Methods such as `fault`, `go_silent` and `reboot` let tests provoke
failures.
"""

import contextlib
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import can
import canopen

from softfin.core.clock import Clock
from softfin.core.json_object import JsonObject
from softfin.emulation.epos2 import motor as motor_states
from softfin.emulation.epos2.motor import EmulatedMotor
from softfin.emulation.epos2.objects import (
    OUT_OF_RANGE,
    READ_ONLY_OBJECTS,
    ProcessData,
    dictionary,
    values,
)
from softfin.emulation.fin import EmulatedFin
from softfin.rig.bus import BusConfig
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Epos2Config, Units
from softfin.rig.devices.epos2.protocol import Bit, Object, State

MOTION_STEP_S = 0.005
RECEIVE_TIMEOUT_S = 0.05
EMULATED_STANDSTILL_RPM = 5
"""Motor speed at which a fault reaction ends and the voltage is disabled [rpm]."""


class _Network(canopen.Network):
    """canopen's network over a cable that can be cut, with threads from the given clock."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self.silent = False

    def send_message(
        self, can_id: int, data: bytes | bytearray | list[int], remote: bool = False
    ) -> None:
        if not self.silent and self.bus is not None:
            super().send_message(can_id, bytes(data), remote)

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        """Send immediately and then every period [s]; returns an object with the methods of
        canopen's periodic task."""
        ended = self._clock.event()
        newest = deque([data], maxlen=1)

        def run() -> None:
            while not ended.is_set():
                with contextlib.suppress(can.CanError, RuntimeError):
                    self.send_message(can_id, newest[0])
                ended.wait(period)

        self._clock.spawn(run, "emulated drive's heartbeat")
        return SimpleNamespace(stop=ended.set, update=newest.append)


class DriveTraits(NamedTuple):
    """Properties in which drives may differ."""

    missing: frozenset[Object] = frozenset()
    """Missing objects."""
    read_only: frozenset[Object] = frozenset()
    """Objects that cannot be written, in addition to those that are read-only by definition."""
    ignores_heartbeat: bool = False
    """Whether the motor keeps running when the host heartbeats end, regardless of the settings."""
    needs_reset_of_communication: bool = False
    """Whether a communication fault can be reset only after an NMT reset communication, as in an
    EPOS4."""


USUAL = DriveTraits()


class EmulatedDrive:
    """A drive set up as described in `config`, powered from construction until `close`."""

    def __init__(
        self,
        bus_config: BusConfig,
        config: Epos2Config,
        fin: EmulatedFin,
        clock: Computer = COMPUTER,
        traits: DriveTraits = USUAL,
    ) -> None:
        self._config = config
        self._clock = clock
        self._traits = traits
        self._lock = clock.lock()
        self._network = _Network(clock)
        node: Any = canopen.LocalNode
        objects = {
            entry: value for entry, value in values(config).items() if entry not in traits.missing
        }
        self._node = node(config.node, dictionary(objects, READ_ONLY_OBJECTS | traits.read_only))
        self._node.add_read_callback(self._live)
        self._node.add_write_callback(self._written)
        self.motor = motor = EmulatedMotor(fin, Units.of(config), self._value, self.fault)
        self.at_limit = False
        """Whether an internal limit is active, e.g. the current limit (bit 11 of the
        statusword)."""
        self._process_data = ProcessData(self._node, self._network.send_message)
        self._readings: dict[int, Callable[[], int]] = {
            protocol.STATUSWORD.number: lambda: self.statusword,
            protocol.ERROR_REGISTER.number: lambda: int(self.state in protocol.FAULT_STATES),
            protocol.MODE_DISPLAY.number: lambda: motor.mode,
            protocol.POSITION.number: lambda: motor.position,
            protocol.DEMAND.number: self._demand,
            protocol.VELOCITY.number: lambda: motor.rpm,
            protocol.MOTOR_CURRENT.number: lambda: motor.current,
        }
        self._ending = clock.event()
        bus = self._network.bus = clock.open_bus(bus_config)
        self._network[config.node] = self._node
        self.reboot()
        self._threads = [
            clock.spawn(lambda: self._receive(bus), "emulated drive's receiver"),
            clock.spawn(self._run, "emulated drive"),
        ]

    def close(self) -> None:
        """Power down; may be called repeatedly."""
        self._ending.set()
        while self._threads:
            self._threads.pop().join(1.0)
        self.motor.release()
        self._node.nmt.stop_heartbeat()
        bus = self._network.bus
        self._network.bus = None
        if bus is not None:
            bus.shutdown()

    def address(self) -> JsonObject:
        """Return an empty address, because the drive is on the bus of the rig, under the number in
        its configuration."""
        return {}

    def remembered(self) -> JsonObject:
        """Return the state that a power loss would erase (the zero), for JSON."""
        return {"zero_counts": self.motor.zero, "referenced": self.motor.referenced}

    def recall(self, remembered: JsonObject) -> None:
        """Continue as if the supply had never been off."""
        self.motor.zero = int(remembered["zero_counts"])
        self.motor.referenced = bool(remembered["referenced"])

    def fault(self, code: int) -> None:
        """Enter a fault: send an emergency frame, update the error history and start the fault
        reaction."""
        with self._lock:
            if self.state in protocol.FAULT_STATES:
                return
            # Reaction 0 disables the voltage immediately; all others are emulated as braking along
            # the steepest ramp.
            brakes = (
                self.state in protocol.POWERED and self._option(protocol.FAULT_REACTION, 2) != 0
            )
            self._enter(State.FAULT_REACTION_ENABLED if brakes else State.FAULT_REACTION_DISABLED)
            self._newest_error = code
            self._is_cut_off = code in protocol.NEEDS_RESET_OF_COMMUNICATION
            self._emergency(code)

    def send_error_frame(self, classes: int, controller: int = 0) -> None:
        """Make the host adapter report an error in a SocketCAN error frame."""
        data = bytes([0, controller, 0, 0, 0, 0, 0, 0])
        frame = can.Message(
            arbitration_id=classes, data=data, is_extended_id=False, is_error_frame=True
        )
        assert self._network.bus is not None
        self._network.bus.send(frame)

    def drop_heartbeat(self) -> None:
        """Stop sending heartbeats; everything else continues."""
        self._node.nmt.stop_heartbeat()

    def go_silent(self) -> None:
        """Cut the cable: nothing is received or sent, and the drive continues by itself."""
        self._network.silent = True

    def reboot(self) -> None:
        """Restart as after a brief power loss, which erases the zero."""
        with self._lock:
            self.state = State.START
            self.motor.power_up()
            self._word = self._newest_error = 0
            self._is_cut_off = False
            self._node.data_store.clear()
            self._restart_communication()

    def _restart_communication(self) -> None:
        """Reset the communication objects to their factory settings and send the boot-up
        message."""
        with self._lock:
            self._is_cut_off = False
            self._host_beat: float | None = None
            # Communication objects are below 0x2000 (CiA 301).
            for index in [index for index in self._node.data_store if index < 0x2000]:
                del self._node.data_store[index]
            self._process_data.enabled.clear()
            self._node.nmt.stop_heartbeat()
            for code in (protocol.NMT_RESET, protocol.NMT_PRE_OPERATIONAL):
                self._node.nmt.send_command(code)

    @property
    def statusword(self) -> int:
        """Current statusword."""
        with self._lock:
            motor = self.motor
            reaches = self.state in {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE}
            bits = {
                Bit.REMOTE: self._node.nmt.state == "OPERATIONAL",
                Bit.TARGET_REACHED: reaches and motor.is_target_reached,
                Bit.LIMIT: self.at_limit,
                Bit.ACKNOWLEDGED: motor.acknowledged,
                Bit.ERROR: self._is_behind(),
                Bit.REFERENCED: motor.referenced,
            }
            return int(self.state.value) | sum(bit for bit, is_set in bits.items() if is_set)

    def _enter(self, state: State) -> None:
        before = self.state
        self.state = state
        if before is state or before not in protocol.POWERED:
            return
        if state in protocol.ENABLING:
            return
        if state in protocol.POWERED:
            self.motor.halt()
        else:
            self.motor.release()

    def _demand(self) -> int:
        return self.motor.demand if self.state is State.OPERATION_ENABLED else self.motor.position

    def _is_behind(self) -> bool:
        return abs(self._demand() - self.motor.position) > self._value(protocol.FOLLOWING_ERROR)

    def _value(self, entry: Object) -> int:
        return int(entry.layout.unpack(self._node.get_data(entry.number, entry.sub))[0])

    def _option(self, entry: Object, default: int) -> int:
        """Return the value of an optional object; `default` is the behaviour of a drive without
        it."""
        return default if entry in self._traits.missing else self._value(entry)

    def _run(self) -> None:
        while not self._ending.wait(MOTION_STEP_S):
            with self._lock, contextlib.suppress(can.CanError):
                self._enter(motor_states.BY_ITSELF.get(self.state, self.state))
                if (
                    self.state is State.FAULT_REACTION_ENABLED
                    and abs(self.motor.rpm) <= EMULATED_STANDSTILL_RPM
                ):
                    self._enter(State.FAULT)
                if self.state is State.OPERATION_ENABLED and self._is_behind():
                    self.fault(0x8611)
                # CiA 301: time in ms in bits 0 to 15, with 0 for no monitoring, and node number in
                # bits 16 to 23.
                silence = self._value(protocol.HEARTBEAT_CONSUMER) & 0xFFFF
                if (
                    silence
                    and self._host_beat is not None
                    and self._clock() - self._host_beat > silence / 1000
                ):
                    self._host_beat = None
                    self._lose_host()

    def _lose_host(self) -> None:
        """React to the loss of the host heartbeats according to 0x6007 and 0x1029 (CiA 402 and
        301)."""
        if self._traits.ignores_heartbeat or self._option(protocol.LOSS_REACTION, 1) == 0:
            return
        self.fault(protocol.HOST_LOST)
        # 0: change to pre-operational; 1: no change; 2: change to stopped.
        behaviour = self._option(protocol.LOSS_BEHAVIOUR, 0)
        if behaviour == 0 and self._node.nmt.state == "OPERATIONAL":
            self._node.nmt.send_command(protocol.NMT_PRE_OPERATIONAL)
        elif behaviour == 2:
            self._node.nmt.send_command(protocol.NMT_STOP)

    def _live(self, index: int, subindex: int, od: object) -> int | None:
        with self._lock:
            if index == protocol.ERROR_COUNT.number:
                return self._newest_error if subindex else int(self._newest_error != 0)
            return self._readings[index]() if index in self._readings else None

    def _written(self, index: int, subindex: int, od: object, data: bytes | bytearray) -> None:
        with self._lock:
            if index == protocol.CONTROLWORD.number:
                was = self.state
                before = self._word
                self._word = protocol.CONTROLWORD.layout.unpack(data)[0]
                if self._is_cut_off and self._traits.needs_reset_of_communication:
                    self._word &= ~protocol.FAULT_RESET
                self._enter(motor_states.next_state(was, self._word, before))
                if was is State.FAULT and self.state is not State.FAULT:
                    self._emergency(0)
                if self.state is State.OPERATION_ENABLED:
                    self.motor.control(self._word, before)
            elif index == protocol.MODE.number:
                mode = protocol.MODE.layout.unpack(data)[0]
                if mode not in (protocol.PROFILE_POSITION, protocol.HOMING):
                    raise canopen.SdoAbortedError(OUT_OF_RANGE)
                self.motor.mode = mode
                self.motor.acknowledged = False
            elif index == protocol.HEARTBEAT_CONSUMER.number:
                # Monitoring starts with the first heartbeat after this (CiA 301).
                self._host_beat = None
            elif index == protocol.ERROR_COUNT.number:
                self._newest_error = 0
            elif 0x1400 <= index < 0x1C00:
                self._process_data.check(index, subindex)

    def _receive(self, bus: can.BusABC) -> None:
        while not self._ending.is_set():
            try:
                message = bus.recv(RECEIVE_TIMEOUT_S)
            except (can.CanError, OSError):
                return
            if message is None or self._network.silent:
                continue
            # canopen would mistake 29-bit identifiers for 11-bit ones.
            if not (message.is_error_frame or message.is_extended_id or message.is_remote_frame):
                # canopen may raise any exception for an invalid frame.
                with contextlib.suppress(Exception):
                    self._take(message.arbitration_id, bytes(message.data))

    def _take(self, cob_id: int, data: bytes) -> None:
        nmt = self._node.nmt
        # canopen's server would print a traceback for an SDO that is too short.
        if cob_id == protocol.SDO_REQUEST + self._config.node and (
            len(data) != 8 or nmt.state == "STOPPED"
        ):
            return
        # canopen answers SDO requests and executes NMT commands.
        self._network.notify(cob_id, bytearray(data), self._clock())
        with self._lock:
            if cob_id == protocol.NMT and nmt.state == "INITIALISING":
                if data[0] == protocol.NMT_RESET_COMMUNICATION:
                    self._restart_communication()
                else:
                    self.reboot()
            elif cob_id & 0x780 == protocol.HEARTBEAT:
                if cob_id & 0x7F == self._value(protocol.HEARTBEAT_CONSUMER) >> 16 & 0x7F:
                    self._host_beat = self._clock()
            elif (
                nmt.state == "OPERATIONAL"
                and cob_id == self._option(protocol.SYNC_ID, protocol.SYNC) & 0x7FF
            ):
                self._process_data.synchronise()
            elif nmt.state == "OPERATIONAL":
                self._process_data.take(cob_id, data)

    def _emergency(self, code: int) -> None:
        if self._node.nmt.state != "STOPPED":
            with contextlib.suppress(can.CanError, RuntimeError):
                # Error register bit 0 is the generic error, which every error sets (CiA 301); the
                # specific bits are not emulated.
                self._node.emcy.send(code, int(code != 0), bytes(5))
