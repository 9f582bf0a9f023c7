"""The drive: a maxon EPOS2 Module 36/2 over CANopen in profile position mode, from a safe start to a safe stop.

One thread, that of the loop, calls everything but `stop`. Tried against our emulator, not yet on a real drive.
Sources: maxon "EPOS2 Firmware Specification" (rel5466) and "Communication Guide" (rel4054), CiA 301 and 402.
"""

import math
from collections.abc import Callable

from softfin.core.clock import REAL, Clock
from softfin.core.errors import CommandError, DeviceError, RigError, SoftfinError
from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2 import power as epos2_power
from softfin.rig.epos2 import setup as epos2_setup
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import BusConfig, DriveConfig, Units
from softfin.rig.epos2.exchange import DriveReading, Exchange
from softfin.rig.epos2.seen import reboot_line
from softfin.rig.epos2.target import Setpoint
from softfin.rig.machine import Target
from softfin.rig.safety import OVERSHOOT_RAD

RESET_TIMEOUT_S = 1.0
FIRST_ANSWER_S = 0.5
STOP_TIMEOUT_S = 2.0
"""For which one stop waits for another that is under way."""
STEP_S = 0.01
UNANSWERED = 3
"""Hand-shakes in a row without an answer after which it is a complaint."""
ROUNDING = 1e-3
"""By which a command may pass a limit [rad, rad/s]: limits are written with three or four digits."""
UNCONFIRMED = "drive did not confirm that its motor is off; press the emergency stop in its supply"


class Epos2:
    """`on_fault(line)` is called in the receiver's thread within milliseconds of a fault; it may call `stop`."""

    def __init__(
        self,
        bus: BusConfig,
        config: DriveConfig,
        clock: Clock = REAL,
        on_fault: Callable[[str], None] | None = None,
    ) -> None:
        self.config, self.units = config, Units.of(config)
        self._clock = clock
        self._exchange = Exchange(bus, config, clock, on_fault)
        self._wire = self._exchange.wire
        self._stopping = clock.lock()
        self._powered = False

    def connect(self) -> None:
        """To the node, whatever its state, changing nothing; raises RigError or DeviceError."""
        self._exchange.reset()
        try:
            self._wire.open()
            epos2_setup.identify(self._wire, self.config)
        except BaseException:
            self._wire.close()
            raise

    def open(self) -> None:
        """Connect, check, write the limits and start the node, without power to the motor; closed again on failure."""
        self.connect()
        try:
            epos2_setup.refuse_busy(self._wire)
            self._powered = False
            epos2_setup.check(self._wire, self.config)
            self._exchange.owned = True
            self._exchange.nmt(objects.NMT_PRE_OPERATIONAL)
            self._wire.tell(objects.CONTROLWORD, cia402.DISABLE_VOLTAGE)
            epos2_setup.configure(self._wire, self.config)
            self._start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop and let go of the bus; any number of times, never raises."""
        self.stop()
        self._exchange.owned = False
        self._wire.close()

    def fault(self) -> str | None:
        """The fault that the drive is in, asked for; None when it is in none. Raises DeviceError."""
        state = cia402.decode(self._wire.ask(objects.STATUSWORD))
        return epos2_setup.fault_of(self._wire) if state in cia402.FAULTS else None

    def reset_fault(self) -> str | None:
        """Acknowledge the drive's fault and return its name; None when there was none. Raises DeviceError.

        After `connect` or `open`; the motor stays without power.
        """
        fault = self.fault()
        if fault is None:
            return None
        with self._exchange.news:
            self._exchange.armed = False
            self._exchange.halts += 1
        # Else it would at once miss the heartbeat of a host that is gone.
        self._wire.tell(objects.HEARTBEAT_CONSUMER, 0)
        for word in cia402.reset_edge():
            self._wire.tell(objects.CONTROLWORD, word)
        for _ in range(round(RESET_TIMEOUT_S / STEP_S)):
            if self.fault() is None:
                self._exchange.seen.emergency = None
                self.sync_and_read()
                return fault
            self._clock.sleep(STEP_S)
        raise DeviceError(f"drive stays in fault: {self.fault()}; the cause is still there")

    def sync_and_read(self, timeout: float = 0.003) -> DriveReading:
        """Have the drive sample, wait for the answers [s]; the newest known where they do not all come."""
        return self._exchange.sync_and_read(timeout)

    def beat(self) -> None:
        """Our heartbeat: a drive that is enabled stops by itself `heartbeat_s` after the last one."""
        self._exchange.beat()

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
        angle = min(max(target.angle, config.angle_min_rad), config.angle_max_rad)
        velocity = min(max(target.velocity, config.slowest_rad_s), config.fastest_rad_s)
        self._exchange.offer(Setpoint(self.units.counts(angle), self.units.rpm(velocity)))

    def complaints(self) -> tuple[str, ...]:
        """What is wrong, each in one line with the way out; none when all is well."""
        with self._exchange.news:
            seen = self._exchange.seen
            silence = self._clock() - seen.heartbeat_time
            lines = (
                seen.fault(),
                reboot_line(self.config.node) if seen.rebooted else None,
                self._exchange.trouble,
                seen.missing(),
                self._wire.state(),
                f"drive's heartbeat is missing for {silence:.2f} s; look at its supply and the bus's cable"
                if silence > self.config.heartbeat_s
                else None,
                f"drive left the operational state (NMT 0x{seen.nmt or 0:02X}); close other programs and start again"
                if not seen.rebooted and seen.nmt != objects.OPERATIONAL
                else None,
                *(self._complaints_enabled() if self._exchange.armed and not seen.fault() else ()),
            )
            return tuple(line for line in lines if line)

    @property
    def stop_unconfirmed(self) -> str | None:
        """Why the motor may still be on after a stop; None where the drive said that it is off."""
        return UNCONFIRMED if self._powered else None

    @property
    def referenced(self) -> bool:
        """Whether the fin was zeroed since the drive's power-up."""
        return self._exchange.seen.has(Bit.REFERENCED)

    @property
    def state(self) -> State | None:
        """By the newest statusword."""
        return self._exchange.seen.state

    def counters(self) -> dict[str, int]:
        """What was counted since `open`."""
        shake, seen = self._exchange.handshake, self._exchange.seen
        targets = {"targets superseded": shake.superseded, "targets repeated": shake.repeated}
        return targets | dict(seen.counters + self._wire.counters)

    def enable(self) -> None:
        """Power to the motor, which holds where it is; raises RigError or DeviceError, and is stopped again then."""
        reading = self._fresh_reading()
        if self.config.zero_needed and not self.referenced:
            raise RigError(
                "fin's zero is not known since the drive's power-up; turn the fin to zero and run: softfin rig zero"
            )
        low, high = self.config.angle_min_rad - OVERSHOOT_RAD, self.config.angle_max_rad + OVERSHOOT_RAD
        if not low <= reading.angle <= high:
            raise RigError(
                f"fin stands at {reading.angle:.3f} rad, outside {self.config.angle_min_rad:g} .. "
                f"{self.config.angle_max_rad:g}; turn it inside by hand, or zero it anew"
            )
        # A homing that failed must not have left its mode: there a target would be a new zero.
        epos2_setup.set_mode(self._wire, objects.PROFILE_POSITION)
        self._power(then_arm=True)

    def home_here(self) -> None:
        """Make the present position the drive's zero (homing method 35); the motor is powered for it, nothing moves."""
        self._fresh_reading()
        epos2_setup.set_mode(self._wire, objects.HOMING)
        try:
            for entry, value in epos2_setup.HOME.items():
                epos2_setup.write(self._wire, entry, value)
            halts = self._power(then_arm=False)
            epos2_power.home(self._exchange, self.config, halts)
        finally:
            self.stop()
            epos2_setup.set_mode(self._wire, objects.PROFILE_POSITION)
        if self.stop_unconfirmed:
            raise DeviceError(self.stop_unconfirmed)

    def stop(self) -> None:
        """Quick stop at once, then no voltage; from any thread, any number of times; never raises."""
        try:
            free = self._exchange.brake()
            if not self._powered:
                return
            if self._wire.in_receiver or not free:
                # The receiver's thread brings the answers that the rest needs; and nobody waits for a bus that hangs.
                self._clock.spawn(self._come_to_rest, "softfin drive stop")
            else:
                self._come_to_rest()
        except Exception as error:
            self._exchange.trouble = f"stop of the drive failed ({error}); press the emergency stop"

    def _start(self) -> None:
        seen = self._exchange.seen
        self._exchange.nmt(objects.NMT_START)
        with self._exchange.news:
            seen.rebooted, seen.emergency = False, None
            seen.nmt, seen.heartbeat_time = None, self._clock()
        for _ in range(round((FIRST_ANSWER_S + self.config.heartbeat_s) / STEP_S)):
            if self.sync_and_read(STEP_S).new and seen.nmt == objects.OPERATIONAL:
                return
            self._clock.sleep(STEP_S)
        raise DeviceError(
            "drive sends no process data or no heartbeat; look at the bus's load and other programs on it"
        )

    def _fresh_reading(self) -> DriveReading:
        if not self._exchange.owned:
            raise DeviceError("drive is not open; open it first")
        readings = (self.sync_and_read(STEP_S) for _ in range(round(FIRST_ANSWER_S / STEP_S)))
        reading = next((each for each in readings if each.new), None)
        if lines := self.complaints():
            raise DeviceError(lines[0])
        if reading is None:
            raise DeviceError("drive does not answer; look at its supply and the bus's cable")
        return reading

    def _power(self, then_arm: bool) -> int:
        """Enabled; the count of halts that it began with."""
        exchange = self._exchange
        if not self._stopping.acquire(timeout=STOP_TIMEOUT_S):
            raise DeviceError("drive is still being stopped; wait, then enable it again")
        try:
            with exchange.news:
                halts = exchange.halts
                exchange.handshake.clear()
                self._powered = True
        finally:
            self._stopping.release()
        try:
            exchange.beat()
            silence = epos2_setup.milliseconds(self.config.heartbeat_s)
            epos2_setup.write(self._wire, objects.HEARTBEAT_CONSUMER, self.config.host_node << 16 | silence)
            epos2_power.reach_enabled(exchange, halts)
            with exchange.news:
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
            if epos2_power.rest(self._exchange, self.config):
                self._powered = False
                # The host's heartbeat ends with the program, which is no fault of a drive that is at rest.
                self._wire.tell(objects.HEARTBEAT_CONSUMER, 0)
            else:
                self._exchange.trouble = UNCONFIRMED
        except SoftfinError as error:
            self._exchange.trouble = str(error)
        finally:
            self._stopping.release()

    def _complaints_enabled(self) -> tuple[str, ...]:
        seen, unanswered = self._exchange.seen, self._exchange.handshake.unanswered
        state = self.state.words if self.state else f"in no state of an EPOS2 (statusword 0x{seen.statusword:04X})"
        lines = (
            (
                self.state is not State.OPERATION_ENABLED,
                f"drive is {state} though it was enabled; look at its enable input and other programs",
            ),
            (
                seen.has(Bit.LIMIT),
                "drive holds back at one of its own limits; ask for less velocity, acceleration or angle",
            ),
            (seen.has(Bit.ERROR), "drive is behind its profile by more than its limit; look for a blocked fin"),
            (
                unanswered >= UNANSWERED,
                f"drive did not take a target {unanswered} times; look at the bus and other programs",
            ),
        )
        return tuple(line for wrong, line in lines if wrong)
