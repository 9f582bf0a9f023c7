"""One session on a machine: unconfigured, inactive (reads, does not move), active (moves), stopped; 100 ticks a second.

At each tick: wait, read, ask everybody whether all is well, record, show. Whatever is wrong, or goes wrong in here,
stops the machine first and is told after.
"""

import gc
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from types import TracebackType
from typing import Literal, NoReturn, Protocol, runtime_checkable

from softfin.core.errors import SafetyStop, SoftfinError
from softfin.core.quantities import RATE_HZ
from softfin.rig.machine import Machine, Sample, Target, clock_of
from softfin.rig.pace import Pace
from softfin.rig.safety import Guard, Trip
from softfin.rig.stop import StopRequest
from softfin.rig.watchdog import Watchdog

State = Literal["unconfigured", "inactive", "active", "stopped"]

Observer = Callable[[Sample, Target | None], None]
"""Called at each tick with what was read and the command under which it came about; must return at once."""

FRESH_S = 1.0
"""Longest time before activation in which all must be well once [s]."""

STILL_RAD = 0.03
"""The shaft is at rest at angle 0 within this [rad]."""

HOMING_S = 10.0
"""Longest way to angle 0 [s]; at 1 rad/s it is 1.6 s. A slower fin has twice the time that it needs."""


@runtime_checkable
class Recorder(Protocol):
    """What keeps a session on disk; none of its methods blocks or raises (`softfin.storage.bag.writer`)."""

    @property
    def failure(self) -> str | None:
        """Why nothing is recorded any more, in one line; None while all is well."""
        ...

    def command(self, time: float, angle: float, velocity: float) -> None:
        """A command as it is issued."""
        ...

    def joint(self, time: float, angle: float, velocity: float, current: float | None) -> None:
        """A reading of the drive."""
        ...

    def wrench(self, time: float, wrench: tuple[float, ...]) -> None:
        """A reading of the force sensor."""
        ...

    def reference(self, time: float, force: tuple[float, ...]) -> None:
        """The force that is asked for, (x, y) [N]."""
        ...

    def event(self, time: float, text: str) -> None:
        """Something worth knowing."""
        ...


class Session:
    """A context: whatever happens, the machine is stopped and closed at its end."""

    def __init__(
        self,
        machine: Machine,
        guard: Guard,
        *,
        stop: StopRequest | None = None,
        observers: Sequence[Observer] = (),
        pace: Pace | None = None,
    ) -> None:
        self.machine, self.guard, self.stop_request = machine, guard, stop or StopRequest()
        self.observers, self.pace = observers, pace or Pace(clock=clock_of(machine))
        self._until_closed = ExitStack()
        self.recorder: Recorder | None = None
        self.state: State = "unconfigured"
        self.target: Target | None = None
        """The command in force."""
        self.newest: Sample | None = None
        self.trip: Trip | None = None
        """Why it was stopped."""
        self._watchdog: Watchdog | None = None
        self._doubt: str | None = None

    def __enter__(self) -> "Session":
        self.machine.open()
        # That of a machine which never knows better; what is in doubt after a stop only is another one.
        self._doubt = self.machine.doubt
        self.state = "inactive"
        self.pace.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._unwatch()
        self.machine.stop()
        doubt, told = self.machine.doubt, self.state == "stopped"
        if not told:
            self._tell("the session ended" if error is None else f"ended by {kind.__name__ if kind else ''}: {error}")
        self.state = "stopped"
        try:
            self.machine.close()
        finally:
            gc.unfreeze()
            self._until_closed.close()
        if not told and doubt is not None and doubt != self._doubt:
            # Whatever ended the session, nobody may take the fin for safe.
            reason = "the session ended" if error is None else _line(error, "the session was ended")
            raise SafetyStop(f"{reason}; BUT {doubt}") from error

    def until_closed(self, context: AbstractContextManager[None]) -> None:
        """Enter a context that ends after the machine is closed: a second Ctrl-C must not come between."""
        self._until_closed.enter_context(context)

    def tick(self) -> Sample:
        """Wait for the next tick, read and check; raises SafetyStop, the machine stopped already."""
        late = self.pace.wait()
        try:
            sample = self.machine.read()
        except Exception as error:
            self.abort(Trip("device", _line(error, "reading the machine failed")))
        now = self.pace.clock()
        if self._watchdog is not None:
            self._watchdog.feed(now)
        moves = self.state == "active"
        # A person's stop first: nothing else explains why the fin stopped.
        trip = self.stop_request.trip or self.trip
        if trip is None and self.recorder is not None and self.recorder.failure is not None:
            trip = Trip("recording", self.recorder.failure)
        if trip is None and moves:
            trip = self.guard.check(sample, now, late)
        if trip is not None:
            self.abort(trip)
        if self.recorder is not None:
            self._record(self.recorder, sample)
        try:
            for observe in self.observers:
                observe(sample, self.target)
        except SafetyStop:
            raise
        except Exception as error:
            self.abort(Trip("observer", _line(error, "what watches the loop failed")))
        self.newest = sample
        return sample

    def activate(self) -> None:
        """Enable the drive, which holds where it is: from now on it may move."""
        if self.state != "inactive":
            raise SafetyStop(f"activated while {self.state}: only an inactive session can be; begin a new one")
        # What is there already is not searched for garbage any more: in a process with JAX that takes 100 ms a time.
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        sample = self._well()
        limits = self.machine.limits
        here = min(max(sample.angle, limits.angle_min), limits.angle_max)
        self.machine.enable()
        # Whatever was read without power says nothing about the motion that begins here.
        self.guard.restart()
        self.state = "active"
        self._tell(f"active: {self.machine.name}")
        self.pace.start()
        self._watchdog = Watchdog(self.guard.config, self._bite, self.pace.clock)
        self.command(Target(here, limits.velocity_min))

    def _well(self) -> Sample:
        """The first sample with which all is well; what was not read for a while needs a moment to be fresh again."""
        self.pace.start()
        self.guard.restart()
        trip: Trip | None = None
        for _ in range(round(FRESH_S * RATE_HZ)):
            sample = self.tick()
            trip = self.guard.check(sample, self.pace.clock())
            if trip is None:
                return sample
        assert trip is not None
        self.abort(trip)

    def deactivate(self) -> None:
        """Stop and disable the motor: slow work may be done now, and `activate` goes on after it."""
        # A brake that takes its time is no silence of the loop.
        self._unwatch()
        self.machine.stop()
        doubt = self.machine.doubt
        if doubt is not None and doubt != self._doubt:
            self.abort(Trip("motor_on", "the fin was told to rest"))
        if self.state == "active":
            self.state, self.target = "inactive", None
            self._tell("inactive")

    def command(self, target: Target) -> None:
        """Issue a command now; raises SafetyStop where it is none that this fin takes."""
        trip = self.guard.check_target(target) or self.stop_request.trip or self.trip
        if trip is not None:
            self.abort(trip)
        if self.state != "active":
            raise SafetyStop(f"commanded while {self.state}: nothing moves before activation")
        try:
            self.machine.command(target)
        except Exception as error:
            self._refused(error)
        self.target = target
        if self.recorder is not None:
            self.recorder.command(self.pace.clock(), target.angle, target.velocity)

    def asked(self, reference: tuple[float, float]) -> None:
        """For the record: the force that is asked for from now on [N]."""
        if self.recorder is not None:
            self.recorder.reference(self.pace.clock(), reference)

    def hold(self, target: Target, ticks: int) -> list[Sample]:
        """Hold a command for so many ticks; what was read after each."""
        self.command(target)
        return [self.tick() for _ in range(ticks)]

    def rest(self, seconds: float) -> None:
        """Go to angle 0 slowly, and wait for so long with the fin at rest, for the water to come to rest too."""
        slowest = self.machine.limits.velocity_min
        self.command(Target(0.0, slowest))
        way = 0.0 if self.newest is None else abs(self.newest.angle)
        longest = max(HOMING_S, 2 * way / slowest)
        for _ in range(round(longest * RATE_HZ)):
            sample = self.tick()
            if abs(sample.angle) < STILL_RAD and abs(sample.velocity) < STILL_RAD:
                break
        else:
            angle = 0.0 if self.newest is None else self.newest.angle
            self.abort(Trip("rest", f"the shaft did not come to rest at angle 0 within {longest:.3g} s (it is at "
                            f"{angle:.3f} rad); is it blocked?"))  # fmt: skip
        for _ in range(round(seconds * RATE_HZ)):
            self.tick()

    def abort(self, trip: Trip) -> NoReturn:
        """Stop the machine, note why, and raise SafetyStop; what stopped it first is the reason that is told."""
        trip = self.trip or trip
        self.machine.stop()
        self._unwatch()
        if self.state != "stopped":
            self.state, self.trip = "stopped", trip
            self._tell(f"stopped: {trip.cause}: {trip.reason}")
        doubt = self.machine.doubt
        if doubt is None:
            raise SafetyStop(f"stopped, motor disabled: {trip.reason}")
        self._tell(f"but {doubt}")
        raise SafetyStop(f"stopped: {trip.reason}; BUT {doubt}")

    def _refused(self, error: Exception) -> NoReturn:
        """A drive in fault takes no command; its fault says more than that."""
        self._unwatch()
        self.machine.stop()
        try:
            complaints = self.machine.read().complaints
        except Exception:
            complaints = ()
        self.abort(Trip("device", complaints[0] if complaints else _line(error, "the machine took no command")))

    def _unwatch(self) -> None:
        if self._watchdog is not None:
            self._watchdog.end()
            self._watchdog = None

    def _bite(self, silence: float) -> None:
        """Called by the watchdog, in its thread."""
        if self.trip is None:
            self.trip = Trip("watchdog", f"the loop was silent for {silence * 1e3:.0f} ms: the computer is too busy, "
                             "or the controller hung; see the last event before")  # fmt: skip
        self.machine.stop()

    def _record(self, recorder: Recorder, sample: Sample) -> None:
        before = self.newest
        if before is None or sample.time > before.time:
            recorder.joint(sample.time, sample.angle, sample.velocity, sample.current)
        if before is None or sample.force_time > before.force_time:
            recorder.wrench(sample.force_time, sample.wrench)

    def _tell(self, text: str) -> None:
        if self.recorder is not None:
            self.recorder.event(self.pace.clock(), text)


def _line(error: BaseException, what: str) -> str:
    """Our own errors say it all in one line; others need a word of what was going on."""
    if isinstance(error, SoftfinError):
        return str(error)
    return f"{what} ({type(error).__name__}: {' '.join(str(error).split())[:300]}); see --debug"
