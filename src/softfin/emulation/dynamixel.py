"""An emulated Dynamixel that speaks Protocol 2.0 byte for byte, on a pseudo-terminal or, in
simulated time, on a simulated line. It turns an emulated fin.

Written from the e-Manual. Not verified there: the torque stays on after the bus watchdog has
tripped (implied by the e-Manual's example), and a servo whose torque is switched on moves to the
goal written before.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable

from softfin.core.json_object import JsonObject
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.network import SimulatedLine
from softfin.emulation.stream import Pty
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.config import DynamixelConfig, Units, position_range
from softfin.rig.devices.dynamixel.protocol import (
    ALERT,
    BROADCAST,
    Entry,
    HardwareError,
    Instruction,
    Packet,
    PacketParser,
    Refusal,
    encode_packet,
)
from softfin.rig.safety import OVERSHOOT_RAD

SERVO_STEP_S = 0.01
"""Maximum time between two checks of the bus watchdog [s]: half of its unit."""

MOUNTED_TICKS = 137
"""Position of the horn at fin angle 0, counted from the middle of the turn, without a homing
offset."""

CONSTANT_ENTRIES = (protocol.MODEL_NUMBER, protocol.FIRMWARE_VERSION, protocol.HARDWARE_ERROR)
"""Entries that only the servo writes, in addition to those from the realtime tick to the
voltage."""

TABLE_BYTES = 256


class EmulatedServo:
    """Emulated servo, running from construction until `close`; faults may be set from any
    thread."""

    def __init__(
        self, config: DynamixelConfig, fin: EmulatedFin, clock: Computer = COMPUTER
    ) -> None:
        self.transmit: Callable[[bytes], Iterable[bytes]] = lambda answer: (answer,)
        """Function that maps an answer to the bytes that arrive; tests may truncate, drop or change
        answers."""
        self.delay_s = 0.0
        """Delay of each answer [s]."""
        self.is_watchdog_broken = False
        self.ignores_offset = False
        """Whether to emulate the firmware fault of DynamixelSDK issue 584. The issue reports only a
        wrong goal when the bus watchdog trips; here, it is the position without the homing offset
        (an assumption)."""
        self.received: list[Packet] = []
        """Instructions for this servo, newest last."""
        self.table = bytearray(TABLE_BYTES)
        self._config = config
        self._units = Units.of(config)
        self._fin = fin
        self._clock = clock
        self._lock = clock.lock()
        self._parser = PacketParser()
        self._silent_until = 0.0
        self._closing = clock.event()
        self._due: deque[tuple[float, bytes]] = deque()
        """Answers and the times at which they are sent [s]."""
        self._set_eeprom()
        self.power_up()
        self._line = (
            SimulatedLine(clock, config.port) if isinstance(clock, SimulatedClock) else Pty()
        )
        self._thread = clock.spawn(self._run, "emulated servo")

    def address(self) -> JsonObject:
        """Return the port in the format of a rig file."""
        return {"port": self._line.name}

    def remembered(self) -> JsonObject:
        """Return the zero, which a real servo keeps by itself."""
        return {"homing_offset": self.get(protocol.HOMING_OFFSET)}

    def recall(self, remembered: JsonObject) -> None:
        """Continue with the zero of an earlier command."""
        self.set(protocol.HOMING_OFFSET, int(remembered["homing_offset"]))

    def close(self) -> None:
        """Stop; may be called repeatedly."""
        self._closing.set()
        self._thread.join()
        self._line.close()

    def get(self, entry: Entry) -> int:
        """Return a value of the control table."""
        return _value(self.table, entry)

    def set(self, entry: Entry, value: int) -> None:
        """Set a value of the control table, whether or not it may be written."""
        entry.layout.pack_into(self.table, entry.address, value)

    def power_up(self) -> None:
        """Restart: the RAM is set to its defaults, and the torque is off."""
        with self._lock:
            self._fin.coast()
            self.table[protocol.EEPROM_END :] = bytes(TABLE_BYTES - protocol.EEPROM_END)
            self.set(protocol.STATUS_RETURN_LEVEL, protocol.ALL_STATUS_PACKETS)
            # By default, each indirect address selects its own data.
            own = range(protocol.INDIRECT_DATA, protocol.INDIRECT_DATA + 28)
            struct.pack_into("<28H", self.table, protocol.INDIRECT_ADDRESS, *own)
            self._started = self._instruction_time = self._clock()

    def trip(self, error: HardwareError) -> None:
        """Detect a hardware error, at which the torque goes off if Shutdown contains it."""
        with self._lock:
            self.set(protocol.HARDWARE_ERROR, self.get(protocol.HARDWARE_ERROR) | error)
            if error & self.get(protocol.SHUTDOWN_ERRORS):
                self._switch_off()

    def silence(self, seconds: float = float("inf")) -> None:
        """Neither receive nor send for a time [s], as with a broken cable; 0 ends the silence."""
        self._silent_until = self._clock() + seconds

    def unplug(self) -> None:
        """Remove the port."""
        self._line.close()

    def _set_eeprom(self) -> None:
        lowest, highest = position_range(self._config, OVERSHOOT_RAD)
        values = {
            protocol.MODEL_NUMBER: self._units.model.number,
            protocol.FIRMWARE_VERSION: 48,
            protocol.SERVO_ID: self._config.id,
            protocol.OPERATING_MODE: protocol.POSITION_MODE,
            protocol.VELOCITY_LIMIT: self._units.speed(self._config.fastest_rad_s),
            protocol.MAX_POSITION_LIMIT: highest,
            protocol.MIN_POSITION_LIMIT: lowest,
            protocol.SHUTDOWN_ERRORS: protocol.SHUTDOWN_DEFAULT,
        }
        for entry, value in values.items():
            self.set(entry, value)

    def _run(self) -> None:
        while not self._closing.is_set():
            if not self._line.is_open:
                # Without a line there is nothing to wait for.
                self._clock.sleep(SERVO_STEP_S)
            wait_s = SERVO_STEP_S
            if self._due:
                wait_s = min(max(self._due[0][0] - self._clock(), 0.0), SERVO_STEP_S)
            data = self._line.receive(wait_s)
            with self._lock:
                answers = self._take(data)
            now = self._clock()
            self._due += [(now + self.delay_s, answer) for answer in answers]
            while self._due and self._due[0][0] <= now:
                for part in self.transmit(self._due.popleft()[1]):
                    self._line.send(part)

    def _take(self, data: bytes) -> list[bytes]:
        now = self._clock()
        answers = []
        is_silent = now < self._silent_until
        for packet in [] if is_silent else self._parser.feed(data):
            self._instruction_time = now
            if packet.servo_id in (self._config.id, BROADCAST):
                self.received.append(packet)
                answers += self._answer(packet)
        self._watch(now)
        return answers

    def _watch(self, now: float) -> None:
        """Stop when no instruction has arrived for the time of the bus watchdog."""
        units = self.get(protocol.BUS_WATCHDOG)
        is_watching = self.get(protocol.TORQUE_ENABLE) and units not in (
            0,
            protocol.WATCHDOG_TRIPPED,
        )
        if not is_watching or self.is_watchdog_broken:
            return
        if now - self._instruction_time > units * protocol.WATCHDOG_UNIT_S:
            self.set(protocol.BUS_WATCHDOG, protocol.WATCHDOG_TRIPPED)
            # The servo stops without a profile (e-Manual, Bus Watchdog), so the quick-stop ramp
            # does not apply.
            self.set(protocol.PROFILE_ACCELERATION, 0)
            self.set(protocol.PROFILE_SPEED, 0)
            position = self._position(self._fin.now().angle)
            if self.ignores_offset:
                position -= self._applied_offset()
            self.set(protocol.GOAL_POSITION, position)
            self._move()

    def _answer(self, packet: Packet) -> list[bytes]:
        is_broadcast = packet.servo_id == BROADCAST
        try:
            instruction = Instruction(packet.instruction)
        except ValueError:
            return [] if is_broadcast else [self._status(b"", Refusal.INSTRUCTION)]
        if instruction is Instruction.PING:
            return [self._status(bytes(self.table[0:2] + self.table[6:7]))]
        if instruction is Instruction.SYNC_READ:
            if self._config.id not in packet.data[4:]:
                return []
            return [self._read(packet.data[:4])]
        level = self.get(protocol.STATUS_RETURN_LEVEL)
        if instruction is Instruction.READ:
            return [self._read(packet.data)] if level >= 1 and not is_broadcast else []
        refusal: Refusal | None = Refusal.INSTRUCTION
        if instruction is Instruction.WRITE:
            refusal = self._write(packet.data)
        elif instruction is Instruction.REBOOT:
            refusal = None
        answer = self._status(b"", refusal)
        if instruction is Instruction.REBOOT:
            self.power_up()
        return [answer] if level >= protocol.ALL_STATUS_PACKETS and not is_broadcast else []

    def _status(self, data: bytes, refusal: Refusal | None = None) -> bytes:
        alert = ALERT if self.get(protocol.HARDWARE_ERROR) else 0
        error = alert | (refusal or 0)
        return encode_packet(
            Packet(self._config.id, Instruction.STATUS, bytes([error]) + bytes(data))
        )

    def _read(self, request: bytes) -> bytes:
        address, size = struct.unpack("<HH", request)
        if address + size > TABLE_BYTES:
            return self._status(b"", Refusal.ACCESS)
        self._measure()
        selected = map(self._resolve, range(address, address + size))
        return self._status(bytes(self.table[each] for each in selected))

    def _resolve(self, address: int) -> int:
        """Return the address that an indirect address selects."""
        offset = address - protocol.INDIRECT_DATA
        if not 0 <= offset < 28:
            return address
        place = protocol.INDIRECT_ADDRESS + 2 * offset
        return int.from_bytes(self.table[place : place + 2], "little")

    def _measure(self) -> None:
        """Update the entries that the servo measures."""
        motion = self._fin.now()
        units = self._units
        per_rad_s = 1 / units.velocity(1)
        values = {
            protocol.REALTIME_TICK: int((self._clock() - self._started) / protocol.TICK_UNIT_S)
            % protocol.TICK_RANGE,
            protocol.PRESENT_CURRENT: round(motion.current / units.current(1)),
            protocol.PRESENT_VELOCITY: round(motion.velocity * per_rad_s),
            protocol.PRESENT_POSITION: self._position(motion.angle),
            protocol.POSITION_TRAJECTORY: self._position(motion.demand),
            protocol.PRESENT_INPUT_VOLTAGE: 120,
        }
        for entry, value in values.items():
            self.set(entry, value)

    def _position(self, angle: float) -> int:
        return self._units.position(angle) + self._offset()

    def _offset(self) -> int:
        """Return the difference between the position of the servo and the position in `Units`."""
        return MOUNTED_TICKS + self._applied_offset()

    def _applied_offset(self) -> int:
        offset = self.get(protocol.HOMING_OFFSET)
        # In position mode, a servo ignores larger offsets.
        return offset if abs(offset) <= protocol.MAX_HOMING_OFFSET else 0

    def _write(self, request: bytes) -> Refusal | None:
        (address,) = struct.unpack("<H", request[:2])
        data = request[2:]
        changed = {address + index: value for index, value in enumerate(data)}
        if refusal := self._refusal(changed):
            return refusal
        had_torque = self.get(protocol.TORQUE_ENABLE)
        for each, value in changed.items():
            self.table[each] = value
        goal = protocol.GOAL_POSITION.address
        torque = self.get(protocol.TORQUE_ENABLE)
        if had_torque and not torque:
            self._switch_off()
        elif torque and (goal in changed or not had_torque):
            self._move()
        return None

    def _refusal(self, changed: dict[int, int]) -> Refusal | None:
        """Return the reason for refusing to write these bytes; None if they are accepted."""
        read_only = {
            entry.address + index
            for entry in CONSTANT_ENTRIES
            for index in range(entry.layout.size)
        }
        read_only |= set(range(protocol.REALTIME_TICK.address, 147))
        if max(changed) >= TABLE_BYTES or read_only & changed.keys():
            return Refusal.ACCESS
        if self.get(protocol.TORQUE_ENABLE) and min(changed) < protocol.EEPROM_END:
            return Refusal.ACCESS
        after = bytearray(self.table)
        for address, value in changed.items():
            after[address] = value
        # After a shutdown, the torque can be switched on only after a restart.
        is_shut_down = self.get(protocol.HARDWARE_ERROR) & self.get(protocol.SHUTDOWN_ERRORS)
        if is_shut_down and _value(after, protocol.TORQUE_ENABLE):
            return Refusal.RESULT_FAIL
        goal = _value(after, protocol.GOAL_POSITION)
        if protocol.GOAL_POSITION.address in changed:
            if self.get(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED:
                return Refusal.DATA_RANGE
            lowest = self.get(protocol.MIN_POSITION_LIMIT)
            if not lowest <= goal <= self.get(protocol.MAX_POSITION_LIMIT):
                return Refusal.DATA_LIMIT
        if _value(after, protocol.PROFILE_SPEED) > self.get(protocol.VELOCITY_LIMIT):
            return Refusal.DATA_LIMIT
        return None

    def _move(self) -> None:
        angle = self._units.angle(self.get(protocol.GOAL_POSITION) - self._offset())
        # 0 means as fast as possible.
        speed = self.get(protocol.PROFILE_SPEED) or self.get(protocol.VELOCITY_LIMIT)
        self._fin.move(angle, abs(self._units.velocity(speed)))

    def _switch_off(self) -> None:
        self.set(protocol.TORQUE_ENABLE, 0)
        self._fin.coast()


def _value(table: bytearray, entry: Entry) -> int:
    return int(entry.layout.unpack_from(table, entry.address)[0])
