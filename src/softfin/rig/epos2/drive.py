"""The drive: a maxon EPOS2 Module 36/2 over CANopen in profile position mode, from a safe start to a safe stop.

One thread, that of the loop, calls everything but `stop`. Tried against our emulator, not yet on a real drive.
Sources: maxon "EPOS2 Firmware Specification" (rel5466) and "Communication Guide" (rel4054), CiA 301 and 402.
"""

import math
from collections.abc import Callable

from softfin.core.clock import REAL, Clock
from softfin.core.errors import CommandError, DeviceError, RigError, SoftfinError
from softfin.rig.epos2 import cia402, objects, power, setup
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import BusConfig, Epos2Config, Units
from softfin.rig.epos2.exchange import DriveReading, Exchange, Setpoint
from softfin.rig.machine import Target
from softfin.rig.safety import OVERSHOOT_RAD

RESET_TIMEOUT_S = 1.0
FIRST_ANSWER_S = 0.5
STOP_TIMEOUT_S = 2.0
"""Longest that one stop waits for another that is under way."""
STEP_S = 0.01
UNANSWERED = 3
"""Hand-shakes in a row without an answer after which it is a complaint."""
ROUNDING = 1e-3
"""How far a command may pass a limit [rad, rad/s]: limits are written with three or four digits."""
UNCONFIRMED = "drive did not confirm that its motor is off; press the emergency stop in its supply"


class Epos2:
    """`on_fault(line)` is called in the receiver's thread within milliseconds of a fault; it may call `stop`."""

    def __init__(
        self,
        bus: BusConfig,
        config: Epos2Config,
        clock: Clock = REAL,
        on_fault: Callable[[str], None] | None = None,
    ) -> None:
        self.config, self.units = config, Units.of(config)
        self._clock = clock
        self._exchange = Exchange(bus, config, clock, on_fault)
        self._connection = self._exchange.connection
        self._stopping = clock.lock()
        self._powered = False

    def connect(self) -> None:
        """Connect to the node, whatever its state, changing nothing; raises RigError or DeviceError."""
        self._exchange.reset()
        try:
            self._connection.open()
            setup.identify(self._connection, self.config)
        except BaseException:
            self._connection.close()
            raise

    def open(self) -> None:
        """Connect, check, write the limits and start the node, without power to the motor; closed again on failure."""
        self.connect()
        try:
            setup.check(self._connection, self.config)
            self._powered = False
            self._exchange.owned = True
            self._exchange.nmt(objects.NMT_PRE_OPERATIONAL)
            self._connection.write(objects.CONTROLWORD, cia402.DISABLE_VOLTAGE)
            setup.configure(self._connection, self.config)
            self._start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop and let go of the bus; any number of times, never raises."""
        self.stop()
        self._exchange.owned = False
        self._connection.close()

    def reset_fault(self) -> str | None:
        """Acknowledge the drive's fault and return its name; None when there was none. Raises DeviceError.

        After `connect` or `open`; the motor stays without power.
        """
        fault = setup.fault_of(self._connection)
        if fault is None:
            return None
        with self._exchange.lock:
            self._exchange.armed = False
            self._exchange.halts += 1
        # Else it would at once miss the heartbeat of a host that is gone.
        self._connection.write(objects.HEARTBEAT_CONSUMER, 0)
        for word in cia402.RESET_EDGE:
            self._connection.write(objects.CONTROLWORD, word)
        for _ in range(round(RESET_TIMEOUT_S / STEP_S)):
            if setup.fault_of(self._connection) is None:
                self._exchange.status.emergency = None
                self.sync_and_read()
                return fault
            self._clock.sleep(STEP_S)
        raise DeviceError(f"drive stays in fault: {fault}; the cause is still there")

    def sync_and_read(self, timeout: float = 0.003) -> DriveReading:
        """Have the drive sample, wait for the answers [s]; the newest known where they do not all come."""
        return self._exchange.sync_and_read(timeout)

    def send_heartbeat(self) -> None:
        """Send our heartbeat: a drive that is enabled stops by itself `heartbeat_s` after the last one."""
        self._exchange.send_heartbeat()

    def command(self, target: Target) -> None:
        """Go there from now on; raises CommandError outside the limits, DeviceError where the drive is not enabled."""
        config = self.config
        bounds = (
            ("angle", target.angle, config.angle_min_rad, config.angle_max_rad),
            ("velocity", target.velocity, config.slowest_rad_s, config.fastest_rad_s),
        )
        for name, value, low, high in bounds:
            if not (math.isfinite(value) and low - ROUNDING <= value <= high + ROUNDING):
                raise CommandError(f"{name} {value:g} is outside {low:g} .. {high:g}; command inside the limits")
        # What passed by a rounding error is put on the limit, which the drive itself keeps to the count.
        angle, velocity = (min(max(value, low), high) for _, value, low, high in bounds)
        self._exchange.offer(Setpoint(self.units.counts(angle), self.units.rpm(velocity)))

    def complaints(self) -> tuple[str, ...]:
        """What is wrong, each in one line with the way out; none when all is well."""
        exchange = self._exchange
        with exchange.lock:
            status, fault = exchange.status, exchange.status.fault()
            silence = self._clock() - status.heartbeat_time
            lines = [fault, status.reboot(), exchange.trouble, status.missing()]
            if silence > self.config.heartbeat_s:
                lines.append(
                    f"drive's heartbeat is missing for {silence:.2f} s; look at its supply and the bus's cable"
                )
            if not status.rebooted and status.nmt != objects.OPERATIONAL:
                lines.append(
                    f"drive left the operational state (NMT 0x{status.nmt or 0:02X}); "
                    "close other programs and start again"
                )
            if exchange.armed and not fault:
                lines += self._complaints_enabled()
            return tuple(line for line in lines if line)

    @property
    def stop_unconfirmed(self) -> str | None:
        """Why the motor may still be on after a stop; None where the drive confirmed that it is off."""
        return UNCONFIRMED if self._powered else None

    @property
    def referenced(self) -> bool:
        """Whether the fin was zeroed since the drive's power-up."""
        return self._exchange.status.has(Bit.REFERENCED)

    @property
    def state(self) -> State | None:
        """State by the newest statusword."""
        return self._exchange.status.state

    def counters(self) -> dict[str, int]:
        """What was counted since `open`, by name."""
        shake, status = self._exchange.handshake, self._exchange.status
        targets = {"targets superseded": shake.superseded, "targets repeated": shake.repeated}
        return targets | dict(status.counters + self._connection.counters)

    def enable(self) -> None:
        """Give power to the motor, which holds where it is; on RigError or DeviceError it is stopped again."""
        angle, low, high = self._new_reading().angle, self.config.angle_min_rad, self.config.angle_max_rad
        if self.config.zero_needed and not self.referenced:
            raise RigError(
                "fin's zero is not known since the drive's power-up; turn the fin to zero and run: softfin rig zero"
            )
        if not low - OVERSHOOT_RAD <= angle <= high + OVERSHOOT_RAD:
            raise RigError(
                f"fin stands at {angle:.3f} rad, outside {low:g} .. {high:g}; turn it inside by hand, or zero it anew"
            )
        # A homing that failed must not have left its mode: there a target would be a new zero.
        setup.set_mode(self._connection, objects.PROFILE_POSITION)
        self._power_up(then_arm=True)

    def home_here(self) -> None:
        """Make the present position the drive's zero (homing method 35); the motor is powered for it, nothing moves."""
        self._new_reading()
        setup.set_mode(self._connection, objects.HOMING)
        try:
            for entry, value in setup.HOME.items():
                setup.write(self._connection, entry, value)
            halts = self._power_up(then_arm=False)
            power.home(self._exchange, self.config, halts)
        finally:
            self.stop()
            setup.set_mode(self._connection, objects.PROFILE_POSITION)
        if self.stop_unconfirmed:
            raise DeviceError(self.stop_unconfirmed)

    def stop(self) -> None:
        """Quick stop at once, then no voltage; from any thread, any number of times; never raises."""
        try:
            free = self._exchange.brake()
            if not self._powered:
                return
            if self._connection.in_receiver or not free:
                # The receiver's thread brings the answers that the rest needs; and nobody waits for a bus that hangs.
                self._clock.spawn(self._come_to_rest, "softfin drive stop")
            else:
                self._come_to_rest()
        except Exception as error:
            self._exchange.trouble = f"stop of the drive failed ({error}); press the emergency stop"

    def _start(self) -> None:
        status = self._exchange.status
        self._exchange.nmt(objects.NMT_START)
        with self._exchange.lock:
            status.rebooted, status.emergency = False, None
            status.nmt, status.heartbeat_time = None, self._clock()
        for _ in range(round((FIRST_ANSWER_S + self.config.heartbeat_s) / STEP_S)):
            if self.sync_and_read(STEP_S).new and status.nmt == objects.OPERATIONAL:
                return
            self._clock.sleep(STEP_S)
        raise DeviceError(
            "drive sends no process data or no heartbeat; look at the bus's load and other programs on it"
        )

    def _new_reading(self) -> DriveReading:
        if not self._exchange.owned:
            raise DeviceError("drive is not open; open it first")
        readings = (self.sync_and_read(STEP_S) for _ in range(round(FIRST_ANSWER_S / STEP_S)))
        reading = next((each for each in readings if each.new), None)
        if lines := self.complaints():
            raise DeviceError(lines[0])
        if reading is None:
            raise DeviceError("drive does not answer; look at its supply and the bus's cable")
        return reading

    def _power_up(self, then_arm: bool) -> int:
        """Enable the drive; the count of halts that it began with."""
        exchange = self._exchange
        if not self._stopping.acquire(timeout=STOP_TIMEOUT_S):
            raise DeviceError("drive is still being stopped; wait, then enable it again")
        try:
            with exchange.lock:
                halts = exchange.halts
                exchange.handshake.clear()
                self._powered = True
        finally:
            self._stopping.release()
        try:
            exchange.send_heartbeat()
            silence = setup.milliseconds(self.config.heartbeat_s)
            setup.write(self._connection, objects.HEARTBEAT_CONSUMER, self.config.host_node << 16 | silence)
            power.reach_enabled(exchange, halts)
            with exchange.lock:
                exchange.refuse_halted(halts)
                exchange.armed = then_arm
        except BaseException:
            self.stop()
            raise
        return halts

    def _come_to_rest(self) -> None:
        if not self._stopping.acquire(timeout=STOP_TIMEOUT_S):
            return
        try:
            if power.rest(self._exchange, self.config):
                self._powered = False
                # The host's heartbeat ends with the program, which is no fault of a drive that is at rest.
                self._connection.write(objects.HEARTBEAT_CONSUMER, 0)
            else:
                self._exchange.trouble = UNCONFIRMED
        except SoftfinError as error:
            self._exchange.trouble = str(error)
        finally:
            self._stopping.release()

    def _complaints_enabled(self) -> list[str]:
        status, unanswered, lines = self._exchange.status, self._exchange.handshake.unanswered, []
        if self.state is not State.OPERATION_ENABLED:
            word = f"in no state of an EPOS2 (statusword 0x{status.statusword:04X})"
            state = self.state.words if self.state else word
            lines.append(f"drive is {state} though it was enabled; look at its enable input and other programs")
        if status.has(Bit.LIMIT):
            lines.append("drive holds back at one of its own limits; ask for less velocity, acceleration or angle")
        if status.has(Bit.ERROR):
            lines.append("drive is behind its profile by more than its limit; look for a blocked fin")
        if unanswered >= UNANSWERED:
            lines.append(f"drive did not take a target {unanswered} times; look at the bus and other programs")
        return lines
