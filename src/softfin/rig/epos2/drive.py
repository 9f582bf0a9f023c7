"""The drive: a maxon EPOS2 Module 36/2 over CANopen in profile position mode, from a safe start to
a safe stop.

One thread, that of the loop, calls everything but `stop`. Tried against our emulator, not yet on a
real drive.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from softfin.core.errors import CommandError, DeviceError, RigError, SafetyStop, SoftfinError
from softfin.rig.epos2 import procedures, protocol
from softfin.rig.epos2.exchange import BEATS_AFTER_STOP, DriveStatus, Exchange
from softfin.rig.epos2.protocol import Bit, State
from softfin.rig.machine import Target
from softfin.rig.safety import OVERSHOOT_RAD, check_target

RESET_TIMEOUT_S = 1.0
LIMITED_S = 0.1
"""Time for which the drive may hold back at a limit of its own: a steep stroke touches one for
milliseconds."""
FIRST_ANSWER_S = 0.5
STOP_TIMEOUT_S = 3.0
"""Longest that one stop waits for another that is under way."""
ANSWER_STEP_S = 0.01
UNANSWERED = 3
"""Hand-shakes in a row without an answer after which it is a complaint."""
UNCONFIRMED = "drive did not confirm that its motor is off; press the emergency stop in its supply"


class Epos2(Exchange):
    """A drive that is opened, enabled, commanded and stopped; `on_fault` may call `stop`."""

    def connect(self) -> None:
        """Connect to the node, whatever its state, changing nothing; raises RigError or
        DeviceError."""
        self.device_lock.acquire(self.clock)
        self.reset()
        try:
            self.connection.open()
            self.foreign_ids = procedures.refuse_others(self.connection, self.config)
            procedures.identify_drive(self.connection)
            self.serial = procedures.read_optional(self.connection, protocol.SERIAL_NUMBER)
        except BaseException:
            self.connection.close()
            self.device_lock.release()
            raise

    def open(self) -> None:
        """Connect, check, write the limits and start the node, without power to the motor; closed
        again on failure."""
        self.connect()
        try:
            self.notes = procedures.check_settings(self.connection, self.config)
            self.powered = False
            self.owned = True
            self.connection.send(
                protocol.NMT, bytes([protocol.NMT_PRE_OPERATIONAL, self.config.node])
            )
            self.connection.write(protocol.CONTROLWORD, protocol.DISABLE_VOLTAGE)
            procedures.configure(self.connection, self.config)
            self.notes += procedures.set_reactions(self.connection)
            self._own_sync()
            self.connection.send(protocol.NMT, bytes([protocol.NMT_START, self.config.node]))
            status = self.status
            with self.lock:
                status.rebooted = False
                status.emergency = None
                status.nmt = None
                status.heartbeat_time = self.clock()
            for _ in range(round((FIRST_ANSWER_S + self.config.heartbeat_s) / ANSWER_STEP_S)):
                if self.sync_and_read(ANSWER_STEP_S).new and status.nmt == protocol.OPERATIONAL:
                    return
                self.clock.sleep(ANSWER_STEP_S)
            raise DeviceError(
                "drive sends no process data or no heartbeat; check the load of the bus and other "
                "programs on it"
            )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop and release the bus; any number of times, never raises."""
        self.stop()
        self.owned = False
        self.connection.close()
        self.device_lock.release()

    def reset_fault(self) -> str | None:
        """Acknowledge the drive's fault and return its name; None when there was none. Raises
        DeviceError.

        The motor stays without power. The drive must be opened again before it is enabled.
        """
        fault = procedures.read_fault(self.connection)
        if fault is None:
            return None
        with self.lock:
            self.armed = False
            self.stopped = True
            self.owned = False
        if procedures.newest_error(self.connection) in protocol.NEEDS_RESET_OF_COMMUNICATION:
            self._reset_communication()
        # Otherwise it would at once miss the heartbeat of a host that is gone.
        self.connection.write(protocol.HEARTBEAT_CONSUMER, 0)
        for word in protocol.RESET_EDGE:
            self.connection.write(protocol.CONTROLWORD, word)
        for _ in range(round(RESET_TIMEOUT_S / ANSWER_STEP_S)):
            if procedures.read_fault(self.connection) is None:
                self.status.emergency = None
                self.sync_and_read()
                return fault
            self.clock.sleep(ANSWER_STEP_S)
        raise DeviceError(f"drive stays in fault: {fault}; the cause is still there")

    def command(self, target: Target) -> None:
        """Go there from now on; raises CommandError outside the limits, DeviceError where the drive
        is not enabled."""
        low_angle, high_angle, slowest, fastest = limits = self.config.limits
        if trip := check_target(target, limits):
            raise CommandError(trip.reason)
        # A target beyond the limit by a rounding error is set to the limit, which the drive itself
        # enforces to the count.
        counts = self.units.counts(min(max(target.angle, low_angle), high_angle))
        rpm = self.units.rpm(min(max(target.velocity, slowest), fastest))
        with self.lock:
            if not self.armed:
                raise DeviceError("drive is not enabled; enable it before you command it")
            self.handshake.waiting = counts, rpm
            self.carry_on()

    def complaints(self) -> tuple[str, ...]:
        """Describe each problem in one line with a fix; empty if there are none."""
        with self.lock:
            status = self.status
            fault = self.status.fault()
            unanswered = self.handshake.unanswered
            silence = self.clock() - status.heartbeat_time
            enabled = self.armed and not fault
            limited_s = 0.0 if status.limited_since is None else self.clock() - status.limited_since
            is_limited = limited_s > LIMITED_S
            lines = (
                (fault, fault),
                (self.trouble != fault, self.trouble),
                (
                    silence > self.config.heartbeat_s,
                    f"drive's heartbeat has been missing for {silence:.2f} s; check its supply and "
                    "the bus cable",
                ),
                (
                    not status.rebooted and status.nmt != protocol.OPERATIONAL,
                    f"drive left the operational state (NMT 0x{status.nmt or 0:02X}); close other "
                    "programs, start again",
                ),
                (
                    enabled and status.state is not State.OPERATION_ENABLED,
                    f"drive is {status.words} although it was enabled; check its enable input and "
                    "other programs",
                ),
                (
                    enabled and is_limited,
                    "drive is held back by one of its own limits; reduce the velocity, "
                    "acceleration or angle",
                ),
                (
                    enabled and status.has(Bit.ERROR),
                    "drive is behind its profile by more than its limit; check for a blocked fin",
                ),
                (
                    enabled and unanswered >= UNANSWERED,
                    f"drive did not accept a target {unanswered} times; check the bus and other "
                    "programs",
                ),
            )
        return tuple(line for is_wrong, line in lines if is_wrong and line)

    @property
    def stop_unconfirmed(self) -> str | None:
        """Reason why the motor may still be on after a stop; None where the drive confirmed that it
        is off."""
        return UNCONFIRMED if self.powered else None

    @property
    def referenced(self) -> bool:
        """Whether the fin was zeroed since the drive's power-up."""
        return self.status.has(Bit.REFERENCED)

    def counters(self) -> dict[str, int]:
        """Counters since `open`, by name."""
        counted = self.status.counters + self.connection.counters
        return {"targets repeated": self.handshake.repeated} | dict(counted)

    def enable(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Give power to the motor, which holds where it is; on RigError or DeviceError it is
        stopped again.

        It takes up to a second; `meanwhile` is called every few milliseconds, so that other devices
        can be read.
        """
        angle = self._new_reading().angle
        low = self.config.angle_min_rad
        high = self.config.angle_max_rad
        if self.config.zero_needed and not self.referenced:
            raise RigError(
                "fin has not been zeroed since the drive's power-up; turn the fin to zero and run: "
                "softfin rig zero --arm"
            )
        if not low - OVERSHOOT_RAD <= angle <= high + OVERSHOOT_RAD:
            raise RigError(
                f"fin is at {angle:.3f} rad, outside {low:g} .. {high:g}; turn it back by "
                "hand, or turn it to zero and run: softfin rig zero --arm"
            )
        # A homing that failed must not have left its mode: there a target would be a new zero.
        procedures.set_mode(self.connection, protocol.PROFILE_POSITION)
        self._power_up(then_arm=True, meanwhile=meanwhile)

    def home_here(self) -> None:
        """Make the present position the drive's zero (homing method 35); the motor is powered for
        it, nothing moves."""
        self._new_reading()
        procedures.set_mode(self.connection, protocol.HOMING)
        with self._stopped_afterwards():
            for entry, value in procedures.HOME.items():
                procedures.write(self.connection, entry, value)
            self._power_up(then_arm=False, meanwhile=lambda: None)
            procedures.home(self)
        procedures.set_mode(self.connection, protocol.PROFILE_POSITION)

    def prove_stop(self) -> float:
        """Power the motor at rest and withhold the heartbeats; return the time until the drive
        faults by itself [s].

        Nothing moves, so no zero is needed. Raises DeviceError if the drive does not fault; it must
        be opened anew.
        """
        self._new_reading()
        # As for homing, so that a fin without a zero may stand beyond the drive's limits of the
        # position.
        procedures.set_mode(self.connection, protocol.HOMING)
        # The fault is what is waited for: a stop from here must not take the power off before the
        # drive does.
        on_fault = self.on_fault
        self.on_fault = None
        try:
            with self._stopped_afterwards():
                self._power_up(then_arm=False)
                faulted_after_s = procedures.time_own_stop(self)
            self.reset_fault()
            return faulted_after_s
        finally:
            self.on_fault = on_fault

    @contextmanager
    def _stopped_afterwards(self) -> Iterator[None]:
        """Stop the motor however this ends; raises SafetyStop if it may still be on then."""
        reason = "the drive was stopped"
        try:
            yield
        except BaseException as error:
            reason = str(error) if isinstance(error, SoftfinError) else "interrupted"
            raise
        finally:
            try:
                self.stop()
            finally:
                # Again, in case Ctrl-C came while it braked; it takes no time if the motor is off.
                self.stop()
                if self.stop_unconfirmed:
                    # This outranks any other error: the operator is next to a powered motor.
                    raise SafetyStop(f"{reason}; BUT {self.stop_unconfirmed}")

    def switch_off(self) -> None:
        """Stop a drive unconditionally, no matter which program powered it; raises DeviceError if
        its motor stays on."""
        self.reset()
        try:
            self.connection.open()
            is_off = procedures.switch_off(self)
        except DeviceError as error:
            raise DeviceError(f"{UNCONFIRMED} ({error})") from None
        finally:
            self.connection.close()
        if not is_off:
            raise DeviceError(f"{UNCONFIRMED}, and end other programs that drive it")

    def stop(self) -> None:
        """Quick stop at once, then no voltage; from any thread, any number of times; never
        raises."""
        try:
            generation = self.generation
            free = self.brake()
            if not self.powered:
                return
            if self.connection.in_receiver or not free:
                # The receiver's thread brings the answers that the rest needs; and nobody waits for
                # a bus that hangs. One such thread at a time, and none after one has failed: a bus
                # that is gone reports an error every 50 ms, and the threads would keep the loop's
                # own stop waiting.
                if self.waiting_stop != generation and not self.rest_failed:
                    self.waiting_stop = generation
                    self.clock.spawn(lambda: self._come_to_rest(generation), "softfin drive stop")
            else:
                self._come_to_rest(generation)
        except Exception as error:
            self.trouble = f"stopping the drive failed ({error}); press the emergency stop"

    def _new_reading(self) -> DriveStatus:
        """Begin to power the motor up: a stop that comes from now on is not forgotten."""
        if not self.owned:
            raise DeviceError("drive is not open; open it first")
        with self.lock:
            self.stopped = False
        is_new = any(
            self.sync_and_read(ANSWER_STEP_S).new
            for _ in range(round(FIRST_ANSWER_S / ANSWER_STEP_S))
        )
        if lines := self.complaints():
            raise DeviceError(lines[0])
        if not is_new:
            raise DeviceError("drive does not answer; check its supply and the bus cable")
        return self.status

    def _own_sync(self) -> None:
        self.sync_id = procedures.set_sync(self.connection, self.config)
        if self.sync_id != protocol.SYNC:
            return
        self.notes += ("drive answers every program's SYNC; give each fin its own bus",)
        if protocol.SYNC in self.foreign_ids:
            raise RigError(
                f"{self.connection.name}: another program sends the SYNC that this drive answers; "
                "give each fin its own bus, or end the other program"
            )

    def _reset_communication(self) -> None:
        """Reset the node's communication and wait for its boot-up; the drive keeps its zero."""
        self.status.rebooted = False
        self.connection.send(
            protocol.NMT, bytes([protocol.NMT_RESET_COMMUNICATION, self.config.node])
        )
        with self.lock:
            # A drive that does not start anew may do without: what counts is whether the fault goes
            # away.
            self.lock.wait_for(lambda: self.status.rebooted, RESET_TIMEOUT_S)
            self.status.rebooted = False

    def _power_up(self, then_arm: bool, meanwhile: Callable[[], object] = lambda: None) -> None:
        if not self.stopping.acquire(timeout=STOP_TIMEOUT_S):
            raise DeviceError("drive is still being stopped; wait, then enable it again")
        try:
            with self.lock:
                if self.stopped:
                    raise DeviceError(
                        "drive was stopped while it was being enabled; enable it again"
                    )
                self.handshake.clear()
                self.powered = True
                self.generation += 1
                self.beats_left = BEATS_AFTER_STOP
                self.rest_failed = False
        finally:
            self.stopping.release()
        try:
            self.send_heartbeat()
            silence = round(1000 * self.config.heartbeat_s)
            procedures.write(
                self.connection, protocol.HEARTBEAT_CONSUMER, self.config.host << 16 | silence
            )
            procedures.reach_enabled(self, then_arm, meanwhile)
        except BaseException:
            self.stop()
            raise

    def _come_to_rest(self, generation: int) -> None:
        """Finish a stop, unless the drive was powered up again since: that motor is not the one to
        take for off."""
        is_acquired = self.stopping.acquire(timeout=STOP_TIMEOUT_S)
        # From here on another stop must wait for itself: this one may be past it.
        self.waiting_stop = None
        if not is_acquired:
            return
        try:
            if generation != self.generation or not self.powered:
                return
            if procedures.rest(self):
                self.powered = False
                # The host's heartbeat ends with the program, which is no fault of a drive that is
                # at rest.
                self.connection.write(protocol.HEARTBEAT_CONSUMER, 0)
            else:
                self.rest_failed = True
                self.trouble = UNCONFIRMED
        except SoftfinError as error:
            self.rest_failed = True
            self.trouble = str(error)
        finally:
            self.stopping.release()
