"""Driver for a Dynamixel in position mode, from a safe start to a safe stop.

The thread of the control loop makes all calls except `stop`, which any thread may call. Tested with
our emulator, not yet with a real servo.

The servo has no quick-stop command. To stop it, softfin commands the position at which it comes to
rest with `quick_stop_rad_s2`, and then switches the torque off. If softfin dies, the bus watchdog
stops the servo, which then holds its position with the torque on.
"""

import os
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress

from softfin.core.dynamixel import CENTER, TICKS_PER_TURN
from softfin.core.errors import DeviceError, RigError
from softfin.core.quantities import TICK_S
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.device import CheckResult, CurrentLimits, DriveReading, RefusedError
from softfin.rig.device_type import DriveType
from softfin.rig.devices.dynamixel import protocol, setup
from softfin.rig.devices.dynamixel.config import DynamixelConfig, Units, position_range
from softfin.rig.devices.dynamixel.link import SETUP_ANSWER_S, NoAnswer, ServoLink
from softfin.rig.devices.dynamixel.protocol import WATCHDOG_TRIPPED, Refusal, Status, error_line
from softfin.rig.devices.dynamixel.sample_clock import SampleClock
from softfin.rig.drive_safety import (
    UNCONFIRMED,
    check_fin_angle,
    check_no_pause,
    stays_off,
    stopped_afterwards,
    try_until,
)
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Target
from softfin.rig.safety import OVERSHOOT_RAD, accept_target

ANSWER_S = 0.006
"""Maximum wait for an answer per tick [s]; an answer takes 2 ms on a real port, and longer on a
busy computer."""

STANDSTILL_RAD_S = 0.1
"""Velocity below which the shaft is treated as at rest [rad/s]: four servo units."""

MEASURED_READINGS = 20
"""Number of readings for which `open` measures the delay."""

DELAY_ATTEMPTS = 3
"""Number of times that `open` measures the delay while most answers seem late."""

SLOWEST_ANSWER_S = 0.005
"""Maximum median delay of an answer [s]; a longer delay would not leave enough time for the rest of
a tick."""

STOP_TIMEOUT_S = 3.0
"""Maximum wait for another stop in progress [s]."""
DISABLE_ATTEMPTS = 8
"""Maximum number of attempts to switch the torque off; each attempt waits for up to two late
answers."""
LATE_ANSWER_S = 0.04
"""Maximum wait for the answer that confirms a stop, if answers are late [s]."""
BLIND_WRITES = 20
"""Number of torque-off writes that `switch_off` sends without waiting for answers; packets may
collide if a second program uses the port."""
LOSS_MARGIN_S = 0.3
"""Time in which a servo must stop after `heartbeat_s` without instructions [s]."""
SHAFT_WATCHED_S = 0.3
"""Time for which softfin watches the shaft after the servo has stopped by itself [s]."""
MOVED_RAD = 0.02
"""Maximum rotation of the shaft during the stop test [rad]; the fin may sway."""
RESET_TIMEOUT_S = 1.0
REFUSED = 3
"""Number of attempts if an earlier stop was not confirmed; small, so that the stop is brief."""
UNANSWERED = 3
"""Number of consecutive ticks without an accepted target after which a problem is reported."""
ZERO_TOLERANCE = 8
"""Maximum distance from the center after zeroing [counts]; the fin may sway."""

WATCHDOG_LINE = f"{setup.WATCHDOG_STOPPED}; {setup.RESET}"

_MOTION = struct.Struct("<iii")
"""Profile acceleration, profile velocity and goal position, which are adjacent in the control
table."""

_PRESENT = struct.Struct("<ii")
"""Present velocity and position, which are adjacent in the control table."""


class Dynamixel:
    """A Dynamixel: open, enable, command, stop."""

    def __init__(self, config: DynamixelConfig, clock: Computer = COMPUTER) -> None:
        self.config = config
        self.clock = clock
        self.link = ServoLink(config, clock)
        self.units = Units.of(config)
        self.where = f"{config.port}, ID {config.id}"
        # The lock is for the port, because the watchdog of a servo does not distinguish between
        # servos.
        self.device_lock = DeviceLock(self.link.name, "serial", os.path.realpath(config.port))
        self.serial: int | None = None
        """None, because a Dynamixel has no serial number."""
        self._firmware: int | None = None
        self._homing_offset: int | None = None
        self.powered = False
        """Whether the motor may be powered; False only after the servo has confirmed that the
        torque is off."""
        self._stopping = clock.lock()
        """Held while a stop brings the motor to rest."""
        self._stop_failed = False
        """Whether a stop since the last power-up was not confirmed; later stops are then brief."""
        self._reset()

    def _reset(self) -> None:
        self.notes: tuple[str, ...] = ()
        """Notes on the servo setup since it was opened, one line each."""
        self.counted: Counter[str] = Counter()
        self.status: Status | None = None
        self._asked = self._time = 0.0
        """Times of the latest request for a status, and of the latest status [s]."""
        self._samples = SampleClock()
        self._trouble: str | None = None
        """Latest problem with the port or a stop, kept until the drive is connected again."""
        self._restarted = False
        self._owned = False
        """Whether this program has set up the servo."""
        self.armed = False
        """Whether targets may be sent."""
        self.stopped = False
        """Whether the drive has been stopped since enabling started."""
        self._motion: bytes | None = None
        """Latest target, repeated until the servo has accepted it."""
        self._goal = 0
        self._unanswered = 0

    def connect(self) -> None:
        """Connect to the servo, in any state, without changing anything; raises RigError or
        DeviceError on failure."""
        self.device_lock.acquire(self.clock)
        self._reset()
        try:
            self.link.open()
            self._firmware = setup.identify_servo(self.link, self.config)
        except BaseException:
            self.link.close()
            self.device_lock.release()
            raise

    def open(self) -> None:
        """Connect, run checks, and select the entries to read; the motor stays off. On failure,
        close the drive."""
        self.connect()
        try:
            setup.answer_everything(self.link)
            setup.check_setup(self.link, self.config)
            self._homing_offset = self.link.read(protocol.HOMING_OFFSET)
            self.powered = False
            self._owned = True
            setup.configure(self.link)
            self._check_delay()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the servo and close the port; may be called repeatedly and never raises."""
        self.stop()
        self._owned = False
        self.link.close()
        self.device_lock.release()

    def read(self) -> DriveReading:
        """Read the servo now; reading also keeps it from stopping by itself."""
        # A servo that does not obey a stop must stop by itself, so nothing more is sent to it.
        is_disobedient = self.stopped and self.powered
        if not is_disobedient and self._poll():
            self._repeat_target()
        status = self._known_status()
        angle = self.units.angle(status.position)
        return DriveReading(
            time=self._time,
            angle=angle,
            velocity=self.units.velocity(status.velocity),
            current=self.units.current(status.current),
            following_error=self.units.angle(status.trajectory) - angle,
            voltage=self.units.voltage(status.voltage),
        )

    def read_angle(self) -> float:
        """Return the current shaft angle [rad]."""
        self._poll(0.02)
        return self.units.angle(self._known_status().position)

    def enable(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Power the motor, which holds its position. If this raises RigError or DeviceError, the
        motor is off."""
        angle = self.units.angle(self._new_status().position)
        if self.config.zero_needed and not self.referenced:
            raise RigError(
                "fin has never been zeroed; turn the fin to zero and run: softfin rig zero --arm"
            )
        check_fin_angle(angle, self.config)
        self._power_up(then_arm=True, meanwhile=meanwhile)

    def command(self, target: Target) -> None:
        """Move to the target, replacing the previous one; raises CommandError if the target is
        outside the limits, and DeviceError if the drive is not enabled."""
        angle, velocity = accept_target(target, self.config.limits)
        goal = self.units.position(angle)
        speed = self.units.speed(velocity)
        acceleration = self.units.acceleration(self.config.acceleration_rad_s2)
        with self.link.lock:
            if not self.armed:
                raise DeviceError("drive is not enabled; enable it before you command it")
            self._goal = goal
            self._motion = _MOTION.pack(acceleration, speed, goal)
            self._unanswered = 0
            self._send_target()

    def stop(self) -> None:
        """Brake immediately, then switch the torque off; may be called repeatedly from any thread
        and never raises."""
        self.armed = False
        self.stopped = True
        try:
            if not self._stopping.acquire(timeout=STOP_TIMEOUT_S):
                return
            try:
                if self.powered:
                    self._come_to_rest()
            finally:
                self._stopping.release()
        except Exception as error:
            self._trouble = f"stopping the drive failed ({error}); press the emergency stop"

    def zero(self) -> None:
        """Make the current angle the zero angle of the fin by setting the homing offset of the
        servo; the motor stays off."""
        status = self._new_status()
        before = self.link.read(protocol.HOMING_OFFSET)
        applied = before if _is_applied(before) else 0
        # An offset of 0 means that the fin has never been zeroed, so use 1 instead, which is an
        # error of 0.09 degrees.
        offset = CENTER - (status.position - applied) or 1
        if not _is_applied(offset):
            degrees = 360 * (status.position - applied) / TICKS_PER_TURN
            raise RigError(
                f"the servo horn is at {degrees:.0f} degrees; mount the fin so that it is within "
                "90 degrees of the middle (180 degrees) when the fin is at zero"
            )
        try:
            setup.write(self.link, protocol.HOMING_OFFSET, offset)
            position = self._new_status().position
            if abs(position - CENTER) > ZERO_TOLERANCE:
                raise DeviceError(
                    f"servo is at {position} after zeroing instead of {CENTER}; hold the fin "
                    "still and try again"
                )
        except BaseException:
            # A zero that has not been checked must not be treated as valid.
            with suppress(RigError, DeviceError):
                setup.write(self.link, protocol.HOMING_OFFSET, before)
            raise
        self._homing_offset = offset

    def reset_fault(self) -> str | None:
        """Acknowledge the servo fault and return its description; None if there was no fault.
        Raises DeviceError if the fault persists.

        The motor stays off. The drive must be reopened before it can be enabled.
        """
        fault = setup.read_fault(self.link)
        if fault is None:
            return None
        self.armed = False
        self.stopped = True
        self._owned = False
        self.link.write(protocol.TORQUE_ENABLE, 0)
        self.link.write(protocol.BUS_WATCHDOG, 0)
        if self.link.read(protocol.HARDWARE_ERROR):
            # Only a restart clears a hardware error (e-Manual, Shutdown).
            self.link.reboot()
        end = self.clock() + RESET_TIMEOUT_S
        while self.clock() < end:
            self.clock.sleep(TICK_S)
            with suppress(NoAnswer):
                if setup.read_fault(self.link) is None and not self._is_powered():
                    return fault
        raise DeviceError(f"drive is still in fault: {fault}; the cause is still present")

    def switch_off(self) -> None:
        """Stop the motor unconditionally, no matter which program powered it; raises DeviceError if
        it is not confirmed to be off.

        Two programs on one port receive each other's answers, so softfin first requests a second
        softfin process on the port to exit. If it does not exit, the torque is switched off without
        braking.
        """
        self._reset()
        is_alone = self.device_lock.take_over(self.clock)
        try:
            # The port is not opened exclusively, because the program that powered the motor may
            # hang.
            self.link.open(exclusive=False)
            if is_alone:
                self._brake_foreign_motion()
            for _ in range(BLIND_WRITES):
                with suppress(DeviceError):
                    self.link.write_unanswered(protocol.TORQUE_ENABLE, 0)
                self.clock.sleep(TICK_S)
            is_off = self._try_until(self._goes_off, STOP_TIMEOUT_S) and stays_off(
                self.clock, lambda: not self._is_powered(), TICK_S
            )
        except DeviceError as error:
            raise DeviceError(f"{UNCONFIRMED} ({error})") from None
        finally:
            self.link.close()
            self.device_lock.release()
        if not is_off:
            raise DeviceError(f"{UNCONFIRMED}, and close any other programs that control it")

    def prove_stop(self) -> float:
        """Power the motor at rest and send nothing; return the time until the servo stops by itself
        [s]. Raises DeviceError if it does not stop or its shaft moves.

        Every instruction restarts the bus watchdog, even an instruction that reads it. softfin is
        therefore silent for longer each time until the watchdog has tripped; the true time is up to
        20 ms shorter.
        """
        before = self._new_status().position
        longest_s = self.config.heartbeat_s + LOSS_MARGIN_S
        with stopped_afterwards(self):
            self._power_up(then_arm=False)
            silence_s = self.config.heartbeat_s
            while silence_s <= longest_s:
                began = self.clock()
                self.clock.sleep(silence_s)
                silent_s = self.clock() - began
                is_new = self._poll(0.02)
                if is_new and self._known_status().watchdog == WATCHDOG_TRIPPED:
                    check_no_pause(silent_s, longest_s)
                    self._watch_shaft(before)
                    return silent_s
                if line := self._fault():
                    raise DeviceError(f"servo stopped for a different reason: {line}")
                silence_s += protocol.WATCHDOG_UNIT_S
        raise DeviceError(
            "servo ignores missing instructions from softfin: it did not stop within "
            f"{silence_s:.2f} s, so the fin would keep moving if softfin died; update its "
            "firmware, and do not move the fin until this test passes"
        )

    def checks(self) -> Iterator[CheckResult]:
        """Describe the open drive."""
        voltage_v = self.units.voltage(self._known_status().voltage)
        text = f"{self.config.model}, {self.where}: limits read, supply {voltage_v:.1f} V"
        yield CheckResult("drive", "well", text)

    def current_limits(self) -> CurrentLimits:
        """Return None: in position mode, the servo does not limit its current (e-Manual, Current
        Limit)."""
        return CurrentLimits(None, None)

    def complaints(self) -> tuple[str, ...]:
        """Return one line per problem, including the fix; empty if there are no problems."""
        if not self._owned:
            return () if self._trouble is None else (self._trouble,)
        lines = []
        fault = self._fault()
        if self._trouble is not None and self._trouble != fault:
            lines.append(self._trouble)
        if fault:
            lines.append(fault)
        status = self.status
        if self.armed and not fault and status is not None and not status.torque:
            lines.append(
                "servo motor is off although it was enabled; check its supply and close other "
                "programs that use it"
            )
        if self.armed and not fault and status and status.watchdog != self.config.watchdog:
            lines.append(
                f"servo setting {protocol.BUS_WATCHDOG} is {status.watchdog} instead of "
                f"{self.config.watchdog}, so the servo might not stop if softfin died; close other "
                "programs that use it"
            )
        # Measure until the latest request, because softfin sends no requests while it is paused.
        silent_s = self._asked - self._time
        if silent_s > self.config.heartbeat_s:
            lines.append(
                f"{self.link.name}: no usable response for {silent_s:.2f} s; check its supply and "
                "cable, and that no second servo has its ID"
            )
        if self._unanswered >= UNANSWERED:
            lines.append(
                f"servo did not accept a target {self._unanswered} times in a row; check its cable "
                "and close other programs that use it"
            )
        return tuple(lines)

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name."""
        return dict(self.counted + self.link.counters)

    @property
    def referenced(self) -> bool:
        """Whether the fin has ever been zeroed; the servo keeps the zero when it is switched
        off."""
        offset = self._homing_offset
        return offset is not None and offset != 0 and _is_applied(offset)

    @property
    def identity(self) -> dict[str, int | str | None]:
        """Type, model, ID, firmware and homing offset. With a homing offset, some firmware versions
        move the servo when the bus watchdog trips."""
        return {
            "type": self.config.type,
            "model": self.config.model,
            "id": self.config.id,
            "firmware": self._firmware,
            "homing_offset": self._homing_offset,
        }

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on after a stop; None if the servo has confirmed that
        the motor is off."""
        return UNCONFIRMED if self.powered else None

    def _poll(self, answer_s: float = ANSWER_S) -> bool:
        """Read a status; return whether it is new."""
        sent = self._asked = self.clock()
        size = protocol.STATUS_LAYOUT.size
        try:
            data = self.link.read_bytes(protocol.INDIRECT_DATA, size, answer_s, "its status")
        except NoAnswer:
            return False
        except DeviceError as error:
            self._trouble = str(error)
            return False
        if not any(data):
            # The indirect addresses have their defaults again, which select themselves.
            self._restarted = True
            return False
        status = Status._make(protocol.STATUS_LAYOUT.unpack(data))
        if self._samples.is_late(sent, status.tick):
            self.counted["late answers"] += 1
            return False
        self.status = status
        # The values were measured after `sent`, so reported ages are never too short.
        self._time = sent
        return True

    def _known_status(self) -> Status:
        if self.status is None:
            raise DeviceError("drive is not open; open it first")
        return self.status

    def _new_status(self) -> Status:
        """Return a new status before the servo is changed; any later stop is remembered."""
        if not self._owned:
            raise DeviceError("drive is not open; open it first")
        self.stopped = False
        is_new = any(self._poll(0.02) for _ in range(MEASURED_READINGS))
        if lines := self.complaints():
            raise DeviceError(lines[0])
        if not is_new:
            raise DeviceError("drive does not respond; check its supply and cable")
        return self._known_status()

    def _check_delay(self) -> None:
        """Measure how fast and how reliably the servo responds."""
        for _ in range(DELAY_ATTEMPTS):
            delays = self._measure_delays()
            if self.counted["late answers"] < MEASURED_READINGS / 2:
                break
            # If a busy computer delays the first request of the age estimate, all later answers
            # seem late.
            self._samples = SampleClock()
            self.counted.clear()
        if len(delays) < 0.9 * MEASURED_READINGS:
            raise DeviceError(
                f"{self.link.name}: only {len(delays)} of {MEASURED_READINGS} responses are "
                "usable; check its cable, termination and baud, and that no second servo has its ID"
            )
        median_s = sorted(delays)[len(delays) // 2]
        if median_s > SLOWEST_ANSWER_S:
            raise RigError(
                f"{self.link.name}: responses take {1e3 * median_s:.0f} ms, which is too long for "
                "100 Hz; set the latency timer of the USB adapter to 1 ms"
            )

    def _measure_delays(self) -> list[float]:
        """Return the delay of each usable answer to `MEASURED_READINGS` requests [s]."""
        delays = []
        for _ in range(MEASURED_READINGS):
            began = self.clock()
            if self._poll(0.05):
                delays.append(self.clock() - began)
        return delays

    def _fault(self) -> str | None:
        """Return the servo fault as of the latest status; None if there is none."""
        if self._restarted:
            return "servo restarted; check its supply and cable, then start again"
        status = self.status
        if status is None:
            return None
        if status.hardware_error:
            return f"{error_line(status.hardware_error)}; {setup.RESET}"
        if status.watchdog == WATCHDOG_TRIPPED:
            return WATCHDOG_LINE
        return None

    def _watch_shaft(self, before: int) -> None:
        """Raise DeviceError if the shaft leaves a position within `SHAFT_WATCHED_S`, or if its
        position cannot be read."""
        is_read = False
        moved_rad = 0.0
        for _ in range(round(SHAFT_WATCHED_S / TICK_S)):
            is_read = self._poll(0.02) or is_read
            angle = self.units.angle(self._known_status().position)
            moved_rad = max(moved_rad, angle - self.units.angle(before), key=abs)
            self.clock.sleep(TICK_S)
        if not is_read:
            raise DeviceError(f"{self.link.name}: no response after it stopped; check its cable")
        if abs(moved_rad) > MOVED_RAD:
            raise DeviceError(
                f"servo: turned the fin by {moved_rad:+.2f} rad during the stop test, possibly due "
                "to a firmware fault (bus watchdog with a homing offset); update its firmware with "
                "DYNAMIXEL Wizard, and do not move the fin until this test passes"
            )

    def _send_target(self) -> None:
        """Send the latest target; the caller holds the lock of the link."""
        if self._motion is None or not self.armed:
            return
        try:
            self.link.write_bytes(
                protocol.PROFILE_ACCELERATION.address, self._motion, ANSWER_S, "a target"
            )
        except NoAnswer:
            # The next status shows whether the servo has accepted it.
            pass
        except RefusedError as error:
            # softfin's targets are within the servo limits, so DATA_RANGE means that the bus
            # watchdog has tripped.
            is_tripped = error.code == Refusal.DATA_RANGE
            self._trouble = WATCHDOG_LINE if is_tripped else str(error)
        except DeviceError as error:
            self._trouble = str(error)

    def _repeat_target(self) -> None:
        with self.link.lock:
            if not self.armed or self._motion is None:
                return
            if self._known_status().goal == self._goal:
                self._unanswered = 0
                return
            self._unanswered += 1
            self.counted["targets repeated"] += 1
            self._send_target()

    def _power_up(self, then_arm: bool, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Switch the torque on, with the present position as the goal and the bus watchdog running;
        on failure, the motor is off."""
        setup.write(self.link, protocol.BUS_WATCHDOG, 0)
        meanwhile()
        self._motion = None
        self._unanswered = 0
        if not self._poll(0.02):
            raise DeviceError("drive does not respond; check its supply and cable")
        config = self.config
        hold = _MOTION.pack(
            self.units.acceleration(config.acceleration_rad_s2),
            self.units.speed(config.slowest_rad_s),
            self._known_status().position,
        )
        self._check_position_limits()
        address = protocol.PROFILE_ACCELERATION.address
        self.link.write_bytes(address, hold, 0.02, "its present position as goal")
        meanwhile()
        try:
            with self.link.lock:
                # In this order, because a stop sets `stopped` before it reads `powered`.
                self.powered = True
                self._stop_failed = False
                self._check_not_stopped()
                # Start the watchdog before the torque, which must never be on without it.
                self.link.write(protocol.BUS_WATCHDOG, config.watchdog)
                self.link.write(protocol.TORQUE_ENABLE, 1)
            meanwhile()
            is_new = self._poll(0.02)
            status = self._known_status()
            if not is_new or not status.torque or status.watchdog != config.watchdog:
                fault = self._fault() or "servo does not switch its torque and bus watchdog on"
                raise DeviceError(f"{fault}; check its supply and cable")
            with self.link.lock:
                self._check_not_stopped()
                self.armed = then_arm
        except BaseException:
            self.stop()
            raise

    def _check_position_limits(self) -> None:
        """Raise RigError if the servo would refuse the present position as a goal; a goal at the
        limit would move the fin while the servo is being enabled."""
        position = self._known_status().position
        lowest = self.link.read(protocol.MIN_POSITION_LIMIT)
        highest = self.link.read(protocol.MAX_POSITION_LIMIT)
        if not lowest <= position <= highest:
            raise RigError(
                f"fin is at {self.units.angle(position):.3f} rad, position {position}, outside the "
                f"servo limits {lowest} to {highest}; turn it back by hand"
            )

    def _check_not_stopped(self) -> None:
        if self.stopped:
            raise DeviceError("drive was stopped while it was being enabled; enable it again")

    def _brake_time(self) -> float:
        """Return the maximum braking time [s]: twice the braking time from the highest velocity,
        plus ten ticks."""
        return 2 * self.config.fastest_rad_s / self.config.quick_stop_rad_s2 + 10 * TICK_S

    def _come_to_rest(self) -> None:
        """Brake, then switch the torque off; the caller holds `_stopping`.

        The time is counted in ticks so that a stop ends even if the clock stops.
        """
        is_brief = self._stop_failed
        # Answers may be late, e.g. because the computer is busy.
        longest_answer_s = ANSWER_S if is_brief else LATE_ANSWER_S
        is_fresh = self.clock() - self._time <= 2 * TICK_S or self._poll()
        braking = self._braking_motion(is_fresh)
        attempts = REFUSED if is_brief else round(self._brake_time() / TICK_S)
        # Also check the clock, because each attempt takes far longer than a tick if the port hangs.
        end = self.clock() + 2 * self._brake_time()
        is_braking = False
        ticks_at_rest = 0
        for _ in range(attempts):
            # If there is no motion, only switch the torque off.
            if braking is None or self.clock() > end:
                break
            if not is_braking:
                is_braking = self._brake(braking)
            is_new = self._poll()
            status = self._known_status()
            if is_new:
                braking = self._braking(status.position, status.velocity)
                if not is_fresh:
                    # The first goal is from an old status and may turn the fin back.
                    is_fresh = True
                    is_braking = self._brake(braking)
            is_still = abs(self.units.velocity(status.velocity)) <= STANDSTILL_RAD_S
            ticks_at_rest = ticks_at_rest + 1 if is_new and is_still else 0
            if ticks_at_rest >= 2 or (is_new and not status.torque):
                break
            self.clock.sleep(TICK_S)
        for attempt in range(REFUSED if is_brief else DISABLE_ATTEMPTS):
            answer_s = longest_answer_s if attempt else ANSWER_S
            with suppress(DeviceError):
                self.link.write(protocol.TORQUE_ENABLE, 0, answer_s)
            # Do not rely on a status, because a servo that has restarted does not send one.
            with suppress(DeviceError):
                self.powered = self._is_powered(answer_s)
            if not self.powered:
                # The end of this program should not cause a fault in a stopped servo.
                with suppress(DeviceError):
                    self.link.write(protocol.BUS_WATCHDOG, 0, ANSWER_S)
                self._poll()
                return
            self.clock.sleep(TICK_S)
        self._stop_failed = True
        self._trouble = UNCONFIRMED

    def _braking_motion(self, is_fresh: bool) -> bytes | None:
        """Return the motion that brakes from the latest status; None if it could turn the fin in
        the wrong direction.

        If the status is not fresh, the position is extrapolated, at most to the goal of the servo.
        """
        status = self.status
        if status is None:
            # The drive was reopened after an unconfirmed stop, so the watchdog has stopped the
            # servo.
            return None
        if is_fresh:
            return self._braking(status.position, status.velocity)
        if status.goal != self._goal:
            # The servo may now move in a different direction.
            return None
        age_s = self.clock() - self._time
        angle = self.units.angle(status.position) + self.units.velocity(status.velocity) * age_s
        ends = sorted((status.position, status.goal))
        position = min(max(self.units.position(angle), ends[0]), ends[1])
        return self._braking(position, 0 if position in ends else status.velocity)

    def _braking(self, position: int, velocity: int) -> bytes:
        """Return the motion command that ends at the stopping position of the servo."""
        config = self.config
        velocity_rad_s = self.units.velocity(velocity)
        # Braking distance: v^2 / (2 a).
        way_rad = velocity_rad_s * abs(velocity_rad_s) / (2 * config.quick_stop_rad_s2)
        # The servo refuses goals outside its limits; a braking fin does not reach them.
        lowest, highest = position_range(config)
        goal = self.units.position(self.units.angle(position) + way_rad)
        goal = min(max(goal, min(lowest, position)), max(highest, position))
        return _MOTION.pack(
            self.units.acceleration(config.quick_stop_rad_s2),
            self.units.speed(config.fastest_rad_s),
            goal,
        )

    def _brake(self, motion: bytes) -> bool:
        """Send a braking motion; return whether the servo has accepted it."""
        address = protocol.PROFILE_ACCELERATION.address
        try:
            self.link.write_bytes(address, motion, ANSWER_S, "a stop")
        except RefusedError as error:
            # The bus watchdog has already stopped the servo.
            return error.code == Refusal.DATA_RANGE
        except DeviceError:
            return False
        return True

    def _is_powered(self, answer_s: float = SETUP_ANSWER_S) -> bool:
        return self.link.read(protocol.TORQUE_ENABLE, answer_s) != 0

    def _brake_foreign_motion(self) -> None:
        """Brake a servo powered by a different program until it is at rest."""
        with suppress(DeviceError):
            setup.answer_everything(self.link)
        # A goal is sent only if the motor is on, because it could power the motor, depending on the
        # drive mode.
        if self._try_until(lambda: not self._is_powered() or self._brake_now(), 0.0):
            self._try_until(self._is_at_rest, self._brake_time())

    def _brake_now(self) -> bool:
        """Brake a servo powered by a different program; return whether it has accepted the goal."""
        data = self.link.read_bytes(
            protocol.PRESENT_VELOCITY.address, _PRESENT.size, SETUP_ANSWER_S, "its motion"
        )
        velocity, position = _PRESENT.unpack(data)
        lowest, highest = position_range(self.config, OVERSHOOT_RAD)
        # A goal from a different position would turn the fin.
        return lowest <= position <= highest and self._brake(self._braking(position, velocity))

    def _is_at_rest(self) -> bool:
        velocity = self.link.read(protocol.PRESENT_VELOCITY)
        return abs(self.units.velocity(velocity)) <= STANDSTILL_RAD_S

    def _try_until(self, done: Callable[[], bool], seconds: float) -> bool:
        return try_until(self.clock, done, seconds, TICK_S)

    def _goes_off(self) -> bool:
        self.link.write(protocol.TORQUE_ENABLE, 0)
        return not self._is_powered()


def _is_applied(homing_offset: int) -> bool:
    """Return whether a servo applies a homing offset; in position mode, it ignores large
    offsets."""
    return abs(homing_offset) <= protocol.MAX_HOMING_OFFSET


# The servo only responds to requests, so faults are found by `read` in the loop that reacts to
# them.
DYNAMIXEL = DriveType(
    DynamixelConfig, lambda config, bus, clock, on_fault: Dynamixel(config, clock)
)
"""The type `dynamixel`."""
