"""Driver for a maxon EPOS2 Module 36/2 over CANopen in profile position mode, from a safe start to
a safe stop.

The thread of the control loop makes all calls except `stop`, which any thread may call. Tested with
our emulator, not yet with a real drive.
"""

from collections.abc import Callable, Iterator
from typing import cast

from softfin.core.errors import DeviceError, RigError, SoftfinError
from softfin.rig.bus import BusConfig
from softfin.rig.device import CheckResult, CurrentLimits, DriveReading
from softfin.rig.device_type import DriveType
from softfin.rig.devices.epos2 import procedures, protocol
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.exchange import BEATS_AFTER_STOP, DriveStatus, Exchange
from softfin.rig.devices.epos2.protocol import Bit, State
from softfin.rig.drive_safety import UNCONFIRMED, check_fin_angle, stopped_afterwards
from softfin.rig.machine import Target
from softfin.rig.safety import accept_target

ANSWER_S = 0.006
"""Maximum wait for drive answers per tick [s]; answers take 1 ms on a real bus, and longer on a
busy computer."""

BEAT_TICKS = 4
"""Ticks between our heartbeats: 40 ms, one fifth of the default heartbeat timeout."""

RESET_TIMEOUT_S = 1.0
LIMITED_S = 0.1
"""Time for which the drive may be at one of its internal limits [s]; a steep stroke reaches a limit
for some milliseconds."""
FIRST_ANSWER_S = 0.5
STOP_TIMEOUT_S = 3.0
"""Maximum wait for another stop in progress [s]."""
ANSWER_STEP_S = 0.01
UNANSWERED = 3
"""Number of consecutive unanswered handshakes after which a problem is reported."""


class Epos2(Exchange):
    """An EPOS2 drive: open, enable, command, stop. `on_fault` may call `stop`."""

    def connect(self) -> None:
        """Connect to the node, in any state, without changing anything; raises RigError or
        DeviceError on failure."""
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
        """Connect, run checks, write the limits and start the node; the motor stays off. On
        failure, close the drive."""
        self.connect()
        try:
            self.notes = procedures.check_setup(self.connection, self.config)
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
                "drive sends no process data or no heartbeat; check the bus load and close other "
                "programs that use the bus"
            )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the drive and release the bus; may be called repeatedly and never raises."""
        self.stop()
        self.owned = False
        self.connection.close()
        self.device_lock.release()

    def read(self) -> DriveReading:
        """Read the drive now; every fourth call also sends a heartbeat."""
        if self._ticks % BEAT_TICKS == 0:
            self.send_heartbeat()
        self._ticks += 1
        status = self.sync_and_read(ANSWER_S)
        return DriveReading(
            time=status.time,
            angle=status.angle,
            velocity=status.velocity,
            current=status.current,
            following_error=status.demand - status.angle,
        )

    def read_angle(self) -> float:
        """Return the current shaft angle [rad]."""
        return self.sync_and_read(0.02).angle

    def reset_fault(self) -> str | None:
        """Acknowledge the drive fault and return its description; None if there was no fault.
        Raises DeviceError if the fault persists.

        The motor stays off. The drive must be reopened before it can be enabled.
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
        # Otherwise, the drive would immediately fault again, because the previous host no longer
        # sends heartbeats.
        self.connection.write(protocol.HEARTBEAT_CONSUMER, 0)
        for word in protocol.RESET_EDGE:
            self.connection.write(protocol.CONTROLWORD, word)
        for _ in range(round(RESET_TIMEOUT_S / ANSWER_STEP_S)):
            if procedures.read_fault(self.connection) is None:
                self.status.emergency = None
                self.sync_and_read()
                return fault
            self.clock.sleep(ANSWER_STEP_S)
        raise DeviceError(f"drive is still in fault: {fault}; the cause is still present")

    def command(self, target: Target) -> None:
        """Move to the target, replacing the previous one; raises CommandError if the target is
        outside the limits, and DeviceError if the drive is not enabled."""
        angle, velocity = accept_target(target, self.config.limits)
        counts = self.units.counts(angle)
        rpm = self.units.rpm(velocity)
        with self.lock:
            if not self.armed:
                raise DeviceError("drive is not enabled; enable it before you command it")
            self.handshake.waiting = counts, rpm
            self.carry_on()

    def complaints(self) -> tuple[str, ...]:
        """Return one line per problem, including the fix; empty if there are no problems."""
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
                    f"drive heartbeat has been missing for {silence:.2f} s; check its supply and "
                    "the bus cable",
                ),
                (
                    not status.rebooted and status.nmt != protocol.OPERATIONAL,
                    f"drive left the operational state (NMT 0x{status.nmt or 0:02X}); close "
                    "other programs and start again",
                ),
                (
                    enabled and status.state is not State.OPERATION_ENABLED,
                    f"drive is {status.words} although it was enabled; check its enable input "
                    "and close other programs that use the drive",
                ),
                (
                    enabled and is_limited,
                    "drive has reached one of its internal limits; reduce the velocity, "
                    "acceleration or angle",
                ),
                (
                    enabled and status.has(Bit.ERROR),
                    "drive exceeds its following error limit; check for a blocked fin",
                ),
                (
                    enabled and unanswered >= UNANSWERED,
                    f"drive did not acknowledge a target {unanswered} times in a row; check the "
                    "bus and close other programs that use the drive",
                ),
            )
        return tuple(line for is_wrong, line in lines if is_wrong and line)

    @property
    def where(self) -> str:
        """Bus of the drive, and its number on the bus."""
        return f"{self.bus.interface} {self.bus.channel}, node {self.config.node}"

    @property
    def identity(self) -> dict[str, int | str | None]:
        """Type, node and serial number."""
        return {"type": self.config.type, "node": self.config.node, "serial": self.serial}

    def checks(self) -> Iterator[CheckResult]:
        """Describe the open drive."""
        text = f"{self.where}: limits, ramps and mapping written and read back"
        yield CheckResult("drive", "well", text)
        yield from (CheckResult("drive setup", "note", note) for note in self.notes)

    def current_limits(self) -> CurrentLimits:
        """Return the limits of the open drive for the motor current."""
        limits_a: list[float | None] = []
        for entry in (protocol.CURRENT_LIMIT, protocol.CONTINUOUS_CURRENT):
            limit_ma = procedures.read_optional(self.connection, entry)
            limits_a.append(None if limit_ma is None else limit_ma / 1000)
        return CurrentLimits(*limits_a)

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on after a stop; None if the drive has confirmed that
        the motor is off."""
        return UNCONFIRMED if self.powered else None

    @property
    def referenced(self) -> bool:
        """Whether the fin has been zeroed since the drive was powered up."""
        return self.status.has(Bit.REFERENCED)

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name."""
        counted = self.status.counters + self.connection.counters
        return {"targets repeated": self.handshake.repeated} | dict(counted)

    def enable(self, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Power the motor, which holds its position. If this raises RigError or DeviceError, the
        motor is off.

        This takes up to one second; `meanwhile` is called every few milliseconds so that other
        devices can be read.
        """
        angle = self._new_reading().angle
        if self.config.zero_needed and not self.referenced:
            raise RigError(
                "fin has not been zeroed since the drive was powered up; turn the fin to zero and "
                "run: softfin rig zero --arm"
            )
        check_fin_angle(angle, self.config)
        # After a failed homing, the drive may still be in homing mode, in which a new target would
        # set a new zero.
        procedures.set_mode(self.connection, protocol.PROFILE_POSITION)
        self._power_up(then_arm=True, meanwhile=meanwhile)

    def zero(self) -> None:
        """Make the current position the zero of the drive (homing method 35); the motor is powered,
        but nothing moves."""
        self._new_reading()
        procedures.set_mode(self.connection, protocol.HOMING)
        with stopped_afterwards(self):
            for entry, value in procedures.HOME.items():
                procedures.write(self.connection, entry, value)
            self._power_up(then_arm=False)
            procedures.home(self)
        procedures.set_mode(self.connection, protocol.PROFILE_POSITION)

    def prove_stop(self) -> float:
        """Power the motor at standstill and withhold heartbeats; return the time until the drive
        faults by itself [s].

        Nothing moves, so the fin does not need to be zeroed. Raises DeviceError if the drive does
        not fault. The drive must be reopened afterwards.
        """
        self._new_reading()
        # Use homing mode, as in `zero`, because a fin that has not been zeroed may be outside the
        # position limits of the drive.
        procedures.set_mode(self.connection, protocol.HOMING)
        # The fault is expected, and `on_fault` must not stop the drive before it stops by itself.
        on_fault = self.on_fault
        self.on_fault = None
        try:
            with stopped_afterwards(self):
                self._power_up(then_arm=False)
                faulted_after_s = procedures.time_own_stop(self)
            self.reset_fault()
            return faulted_after_s
        finally:
            self.on_fault = on_fault

    def switch_off(self) -> None:
        """Stop the drive unconditionally, no matter which program powered it; raises DeviceError if
        the motor is not confirmed to be off."""
        problem = self._switch_off()
        if problem is None:
            return
        try:
            self.device_lock.acquire(self.clock)
        except RigError:
            # Two programs cannot share some CAN adapters, e.g. serial ones.
            self.device_lock.take_over(self.clock)
            problem = self._switch_off()
        finally:
            self.device_lock.release()
        if problem is not None:
            raise DeviceError(problem)

    def _switch_off(self) -> str | None:
        """Switch the motor off; return the problem if the motor is not confirmed to be off."""
        self.reset()
        try:
            self.connection.open()
            if procedures.switch_off(self):
                return None
        except (DeviceError, RigError) as error:
            return f"{UNCONFIRMED} ({error})"
        finally:
            self.connection.close()
        return f"{UNCONFIRMED}, and close any other programs that control it"

    def stop(self) -> None:
        """Quick-stop immediately, then disable voltage; may be called repeatedly from any thread
        and never raises."""
        try:
            generation = self.generation
            free = self.brake()
            if not self.powered:
                return
            if self.connection.in_receiver or not free:
                # The rest of the stop needs answers from the receiver thread and must not block if
                # the bus hangs, so it runs in its own thread. There is only one such thread at a
                # time and none after a failure: a lost bus reports an error every 50 ms, and the
                # threads would delay the stop by the loop.
                if self.waiting_stop != generation and not self.rest_failed:
                    self.waiting_stop = generation
                    self.clock.spawn(lambda: self._come_to_rest(generation), "softfin drive stop")
            else:
                self._come_to_rest(generation)
        except Exception as error:
            self.trouble = f"stopping the drive failed ({error}); press the emergency stop"

    def _new_reading(self) -> DriveStatus:
        """Return a new status before the motor is powered; any later stop is remembered."""
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
            raise DeviceError("drive does not respond; check its supply and the bus cable")
        return self.status

    def _own_sync(self) -> None:
        self.sync_id = procedures.set_sync(self.connection, self.config)
        if self.sync_id != protocol.SYNC:
            return
        self.notes += (
            "drive responds to the SYNC of every program; connect each fin to its own bus",
        )
        if protocol.SYNC in self.foreign_ids:
            raise RigError(
                f"{self.connection.name}: another program sends the SYNC that this drive responds "
                "to; connect each fin to its own bus, or close the other program"
            )

    def _reset_communication(self) -> None:
        """Reset the communication of the node and wait for its boot-up message; the drive keeps its
        zero."""
        self.status.rebooted = False
        self.connection.send(
            protocol.NMT, bytes([protocol.NMT_RESET_COMMUNICATION, self.config.node])
        )
        with self.lock:
            # A missing boot-up message is not an error; only the fault must clear.
            self.lock.wait_for(lambda: self.status.rebooted, RESET_TIMEOUT_S)
            self.status.rebooted = False

    def _power_up(self, then_arm: bool, meanwhile: Callable[[], object] = lambda: None) -> None:
        if not self.stopping.acquire(timeout=STOP_TIMEOUT_S):
            raise DeviceError("drive is still stopping; wait, then enable it again")
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
            # CiA 301, object 0x1016: node number in bits 16 to 23, time in ms in bits 0 to 15.
            silence = round(1000 * self.config.heartbeat_s)
            procedures.write(
                self.connection, protocol.HEARTBEAT_CONSUMER, self.config.host << 16 | silence
            )
            procedures.reach_enabled(self, then_arm, meanwhile)
        except BaseException:
            self.stop()
            raise

    def _come_to_rest(self, generation: int) -> None:
        """Finish a stop unless the drive has been powered up again, because this stop must not then
        mark the motor as off."""
        is_acquired = self.stopping.acquire(timeout=STOP_TIMEOUT_S)
        # From here on, another stop must start its own thread, because this thread may have already
        # passed the step that the other stop needs.
        self.waiting_stop = None
        if not is_acquired:
            return
        try:
            if generation != self.generation or not self.powered:
                return
            if procedures.rest(self):
                self.powered = False
                # The host heartbeat ends with the program, which should not cause a fault in a
                # stopped drive.
                self.connection.write(protocol.HEARTBEAT_CONSUMER, 0)
            else:
                self.rest_failed = True
                self.trouble = UNCONFIRMED
        except SoftfinError as error:
            self.rest_failed = True
            self.trouble = str(error)
        finally:
            self.stopping.release()


# RigConfig requires a bus for this drive.
EPOS2 = DriveType(
    Epos2Config,
    lambda config, bus, clock, on_fault: Epos2(cast(BusConfig, bus), config, clock, on_fault),
)
"""The type `epos2`."""
