"""A session on a machine at 100 ticks per second. Its states are unconfigured, inactive (reads but
does not move), active (moves) and stopped.

Each tick waits, reads, checks, records and calls the observers. After any fault or error, the
machine is first stopped, and then the problem is reported.
"""

import contextlib
import gc
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Literal, NoReturn, TypeAlias

from softfin.core.errors import RunError, SafetyStop, SoftfinError, one_line
from softfin.core.quantities import RATE_HZ
from softfin.rig.loss_estimate import explain_losses
from softfin.rig.machine import Machine, Sample, Target, machine_clock
from softfin.rig.pace import Pace
from softfin.rig.priority import NORMAL, set_loop_priority, set_priority
from softfin.rig.safety import Guard, Trip, check_target
from softfin.rig.stop import StopRequest, Watchdog, stopped_by_signals
from softfin.storage.bag.writer import BagRecorder
from softfin.storage.bag.zero import zero_event

MeasuredForce: TypeAlias = tuple[float, float]
"""Force (x, y) [N]."""

SessionState = Literal["unconfigured", "inactive", "active", "stopped"]

Warn = Callable[[str], None]
"""Function that shows a one-line warning to the operator."""

Observer = Callable[[Sample, Target | None], None]
"""Function called at each tick with the sample and the active command; must return
immediately."""

FRESH_TICKS = 200
"""Number of ticks before activation within which all checks must pass; a single tick may take one
second on a busy computer."""

GOOD_TICKS = 10
"""Number of consecutive ticks at which all checks must pass before the motor is powered. One tick
is not enough: after a pause, the first records from the socket are old, an empty filter needs 7
ticks to fill, and an intermittent fault could return when the motor is on."""

STILL_RAD = 0.03
"""Distance from the rest angle, and angular velocity, below which the shaft is at rest [rad,
rad/s]."""

SUSPENDED_S = 0.05
"""Maximum suspension of the computer that does not stop an active session [s]. The monotonic clock
stops during a suspend, so no tick is late and no reading seems old afterwards, although the fin
moved unsupervised."""

HOMING_S = 10.0
"""Maximum time to reach the rest angle [s]; from 90 degrees, a fin takes 1.6 s at 1 rad/s. For a
slower fin, the limit is twice the time that it needs."""


class Session:
    """Context manager that always stops and closes the machine on exit."""

    def __init__(
        self,
        machine: Machine,
        guard: Guard,
        *,
        stop: StopRequest | None = None,
        observers: Sequence[Observer] = (),
        warn: Warn = lambda line: None,
    ) -> None:
        """Start unconfigured; `warn` is called at the end if many sensor records were lost or
        unusable."""
        self.machine = machine
        self.guard = guard
        self.stop_request = stop or StopRequest()
        self.observers = observers
        self._warn = warn
        self._counted: Counter[str] = Counter()
        """Counters of the machine while the fin was active. Losses at other times do not matter,
        because softfin may not be reading the sensor."""
        self.pace = Pace(machine_clock(machine))
        self.recorder: BagRecorder | None = None
        self.state: SessionState = "unconfigured"
        self.target: Target | None = None
        """Active command."""
        self.newest: Sample | None = None
        """Sample of the latest tick."""
        self.at_rest: list[Sample] = []
        """Samples over which `rest` measured the force; empty before the first rest."""
        self.trip: Trip | None = None
        """Reason why the session was stopped."""
        self._until_closed = ExitStack()
        self._watchdog: Watchdog | None = None
        self._never_confirmed: str | None = None
        self._suspended_s = 0.0
        """Total suspension of the computer up to the last tick before activation [s]."""

    def __enter__(self) -> "Session":
        self.machine.open()
        # A machine that can never confirm a stop may still be used; only later changes to this
        # warning are reported.
        self._never_confirmed = self.machine.stop_unconfirmed
        self.state = "inactive"
        self.pace.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop_request.is_obeyed = True
        self._unwatch()
        self.machine.stop()
        unconfirmed = self.machine.stop_unconfirmed
        is_confirmed = self._is_confirmed()
        was_reported = self.state == "stopped"
        if not was_reported:
            self._record_event(
                "the session ended" if kind is None else f"ended by {kind.__name__}: {error}"
            )
        self._leave("stopped")
        try:
            self.machine.close()
        finally:
            gc.unfreeze()
            self._until_closed.close()
        if (warning := explain_losses(self._counted)) is not None:
            # The terminal may be closed.
            with contextlib.suppress(OSError):
                self._warn(warning)
        if not was_reported and not is_confirmed:
            # Regardless of why the session ended, warn the operator that the fin may not be safe.
            reason = (
                "the session ended"
                if error is None
                else in_one_line(error, "the session was ended")
            )
            raise SafetyStop(f"{reason}; BUT {unconfirmed}") from error

    def stop_on_signals(self) -> None:
        """Make Ctrl-C and other stop signals request a stop until the machine is closed."""
        self._until_closed.enter_context(stopped_by_signals(self.stop_request))

    @contextmanager
    def recording(self, path: Path) -> Iterator[BagRecorder]:
        """Record the session within this context; an existing bag is renamed, not overwritten."""
        if path.exists():
            names = (
                path.with_name(f"{path.stem}.cut-{number}{path.suffix}") for number in count(1)
            )
            path.rename(next(name for name in names if not name.exists()))
        recorder = self.recorder = BagRecorder(path, clock=self.pace.clock)
        try:
            yield recorder
        except BaseException as error:
            self.machine.stop()
            if not isinstance(error, SafetyStop):
                self._record_event(f"ended by {type(error).__name__}: {error}")
            raise
        finally:
            self.recorder = None
            recorder.close()
        if recorder.failure is not None:
            raise RunError(recorder.failure)

    def tick(self) -> Sample:
        """Wait for the next tick, read and check; on a fault, stop the machine and raise
        SafetyStop."""
        late = self.pace.wait()
        try:
            sample = self.machine.read()
        except Exception as error:
            self.abort(Trip("device", in_one_line(error, "reading the machine failed")))
        now = self.pace.clock()
        if self._watchdog is not None:
            self._watchdog.feed(now)
        trip = self._find_trip(sample, now, late)
        if trip is not None:
            self.abort(trip)
        self._record_sample(sample)
        try:
            for observe in self.observers:
                observe(sample, self.target)
        except Exception as error:
            self.abort(Trip("observer", in_one_line(error, "an observer of the loop failed")))
        self.newest = sample
        return sample

    def _find_trip(self, sample: Sample, now: float, late: float) -> Trip | None:
        slept_s = self.pace.clock.suspended() - self._suspended_s
        if self.state != "active":
            self._suspended_s += slept_s
        # A stop by the operator takes precedence, because it is the real cause of all subsequent
        # faults.
        if trip := self.stop_request.trip or self.trip:
            return trip
        if self.recorder is not None and self.recorder.failure is not None:
            return Trip("recording", self.recorder.failure)
        if self.state != "active":
            return None
        # Always call the guard, because it keeps a history of samples.
        trip = self.guard.check(sample, now, late)
        if slept_s > SUSPENDED_S:
            # This replaces the drive fault caused by the suspension.
            return Trip(
                "suspended",
                f"the computer was suspended for {slept_s:.1f} s while the fin was active; start "
                "softfin with: systemd-inhibit --what=sleep:handle-lid-switch softfin ..",
            )
        return trip

    def _record_sample(self, sample: Sample) -> None:
        """Record readings that are newer than the readings in the previous sample."""
        if self.recorder is None:
            return
        before = self.newest
        if before is None or sample.time > before.time:
            self.recorder.joint(
                sample.time, sample.angle, sample.velocity, sample.current, sample.voltage
            )
        if before is None or sample.force_time > before.force_time:
            self.recorder.wrench(sample.force_time, sample.wrench)

    def activate(self) -> None:
        """Enable the drive, which holds its position; from now on, the fin may move."""
        if self.state != "inactive":
            raise SafetyStop(
                f"activate called while {self.state}: the session must be inactive; start a new one"
            )
        # Exclude all existing objects from garbage collection, because one collection takes 100 ms
        # in a process with JAX.
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        self.pace.start()
        self.guard.restart()
        sample = self._await_good_ticks()
        limits = self.machine.limits
        # The fin may rest slightly outside the command range.
        here = min(max(sample.angle, limits.angle_min), limits.angle_max)
        # An observer of the last tick may have requested a stop.
        if trip := self.stop_request.trip or self.trip:
            self.abort(trip)
        self.machine.enable()
        # Samples read without power are not part of the motion that starts here.
        self.guard.restart()
        self.state = "active"
        self._counted.subtract(self.machine.counters())
        self._record_event(f"active: {self.machine.name}")
        set_loop_priority(self.pace.clock)
        self.pace.start()
        self._watchdog = Watchdog(
            self.guard.config.watchdog_s, self._stop_silent_loop, self.pace.clock
        )
        self.command(Target(here, limits.velocity_min))

    def deactivate(self) -> None:
        """Stop and disable the motor, e.g. for slow work before the next `activate`."""
        # The watchdog must not mistake slow braking for a silent loop.
        self._unwatch()
        self.machine.stop()
        if not self._is_confirmed():
            self.abort(Trip("motor_on", "the drive did not confirm power-off"))
        if self.state == "active":
            self._leave("inactive")
            self.target = None
            self._record_event("inactive")

    def command(self, target: Target) -> None:
        """Send a command now; raises SafetyStop if it is outside the limits of the fin or the drive
        refuses it."""
        trip = check_target(target, self.guard.limits) or self.stop_request.trip or self.trip
        if trip is not None:
            self.abort(trip)
        if self.state != "active":
            raise SafetyStop(
                f"command called while {self.state}: the session must be active; activate it first"
            )
        try:
            self.machine.command(target)
        except Exception as error:
            self._unwatch()
            self.machine.stop()
            reason = in_one_line(error, "the machine refused the command")
            with contextlib.suppress(Exception):
                # A drive in fault refuses commands, and the fault is a better reason for the stop.
                reason = next(iter(self.machine.read().complaints), reason)
            self.abort(Trip("device", reason))
        self.target = target
        if self.recorder is not None:
            self.recorder.command(self.pace.clock(), target.angle, target.velocity)

    def record_reference(self, reference: tuple[float, float]) -> None:
        """Record the reference force that applies from now on [N]."""
        if self.recorder is not None:
            self.recorder.reference(self.pace.clock(), reference)

    def hold(self, target: Target, ticks: int) -> list[Sample]:
        """Hold a command for `ticks` ticks and return their samples."""
        self.command(target)
        return [self.tick() for _ in range(ticks)]

    def rest(self, seconds: float) -> MeasuredForce:
        """Move slowly to the rest angle and wait for `seconds` until the water is calm.

        Return the mean force (x, y) over the second half of the wait [N]. The true force is then
        zero, so the mean is the sensor offset for the next experiment. Drift changes the offset, so
        it is measured before each experiment.
        """
        slowest = self.machine.limits.velocity_min
        angle = self.machine.limits.rest_angle
        sample = self.newest or self.tick()
        longest = max(HOMING_S, 2 * abs(sample.angle - angle) / slowest)
        self.command(Target(angle, slowest))
        for _ in range(round(longest * RATE_HZ)):
            sample = self.tick()
            if abs(sample.angle - angle) < STILL_RAD and abs(sample.velocity) < STILL_RAD:
                break
        else:
            self.abort(
                Trip(
                    "rest",
                    f"the shaft did not come to rest at angle {angle:.3g} within {longest:.3g} s "
                    f"(it is at {sample.angle:.3f} rad); check for a blocked fin",
                )
            )
        samples = [self.tick() for _ in range(round(seconds * RATE_HZ))]
        self.at_rest = samples[len(samples) // 2 :]
        zero = mean_force(self.at_rest)
        self._record_event(zero_event(zero))
        return zero

    def abort(self, trip: Trip) -> NoReturn:
        """Stop the machine, record the reason and raise SafetyStop; only the reason for the first
        stop counts."""
        trip = self.trip or trip
        self.stop_request.is_obeyed = True
        self.machine.stop()
        self._unwatch()
        if self.state != "stopped":
            self._leave("stopped")
            self.trip = trip
            self._record_event(f"stopped: {trip.cause}: {trip.reason}")
        unconfirmed = self.machine.stop_unconfirmed
        if unconfirmed is None:
            raise SafetyStop(f"stopped, motor disabled: {trip.reason}", trip.cause, True)
        self._record_event(f"but {unconfirmed}")
        is_confirmed = self._is_confirmed()
        raise SafetyStop(f"stopped: {trip.reason}; BUT {unconfirmed}", trip.cause, is_confirmed)

    def _is_confirmed(self) -> bool:
        """Return whether the motor is off, as far as the machine can ever confirm it."""
        return self.machine.stop_unconfirmed in (None, self._never_confirmed)

    def _await_good_ticks(self) -> Sample:
        """Tick until all checks have passed for `GOOD_TICKS` ticks, because devices need a moment
        to deliver new readings after a pause."""
        good_ticks = 0
        latest_trip: Trip | None = None
        for _ in range(FRESH_TICKS):
            sample = self.tick()
            trip = self.guard.check(sample, self.pace.clock())
            latest_trip = trip or latest_trip
            good_ticks = good_ticks + 1 if trip is None else 0
            if good_ticks == GOOD_TICKS:
                return sample
        assert latest_trip is not None
        self.abort(latest_trip)

    def _leave(self, state: SessionState) -> None:
        """Change to a state in which the fin does not move, and the loop may be late."""
        set_priority(NORMAL, self.pace.clock)
        if self.state == "active":
            # Nothing may prevent a stopped machine from being closed.
            with contextlib.suppress(Exception):
                self._counted.update(self.machine.counters())
        self.state = state

    def _unwatch(self) -> None:
        if self._watchdog is not None:
            self._watchdog.end()
            self._watchdog = None

    def _stop_silent_loop(self, silence: float) -> None:
        """Stop the machine; called from the watchdog thread."""
        if self.trip is None:
            self.trip = Trip(
                "watchdog",
                f"the loop was silent for {silence * 1e3:.0f} ms: the computer is too busy or "
                "the controller hung; see the previous event in the recording",
            )
        self.machine.stop()

    def _record_event(self, text: str) -> None:
        if self.recorder is not None:
            self.recorder.event(self.pace.clock(), text)


def mean_force(samples: Sequence[Sample]) -> MeasuredForce:
    """Return the mean force (x, y) of the samples [N]; zero if there are none."""
    count = max(len(samples), 1)
    return sum(s.wrench[0] for s in samples) / count, sum(s.wrench[1] for s in samples) / count


def in_one_line(error: BaseException, what: str) -> str:
    """Describe an error in one line, which starts with `what` unless it is one of softfin's
    errors."""
    if isinstance(error, SoftfinError):
        return str(error)
    return f"{what} ({type(error).__name__}: {one_line(error)}); see --debug"
