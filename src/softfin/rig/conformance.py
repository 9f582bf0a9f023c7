"""Whether a machine of one's own meets the Machine contract: tried on it, with its fin free to move."""

from collections.abc import Callable
from typing import Any, NoReturn

from softfin.core.clock import Clock
from softfin.core.errors import RigError
from softfin.rig.machine import Machine, Sample, Target, clock_of
from softfin.rig.pace import Pace

STEP_RAD = 0.2
"""The fin is moved by so much, towards the middle of its range."""

NOTICED_RAD = 0.05
"""A fin that went so far has moved [rad]."""

STILL_RAD = 0.02
"""One that went no further has stopped."""

STALE_S = 0.2
"""Oldest reading."""

QUICK_S = 0.02
"""Longest that `read` and `command` may take in the median [s]."""

WATCHED = 100
"""Ticks of each part."""


def check_machine(machine: Any, pace: Pace | None = None) -> None:
    """Raise RigError, with what is wrong and what is asked, unless `machine` meets the contract; THE FIN MOVES.

    Checked: the members, that it stays still until it is enabled and then holds, that readings are finite, fresh and in
    order, that a command moves it, that a stop from this and from another thread ends it, that stop and close may be
    called at any time and again, and that it opens anew. It takes some seconds.
    """
    if not isinstance(machine, Machine):
        names = ("name", "limits", "notes", "doubt", "open", "read", "enable", "command", "stop", "close", "counters")
        missing = [name for name in names if not hasattr(machine, name)]
        _fail(machine, f"has no {', '.join(missing)}", "softfin.rig.machine.Machine says what they do")
    machine.stop()
    machine.close()
    tried = _Tried(machine, pace or Pace(clock=clock_of(machine)))
    try:
        for stop in (machine.stop, lambda: _elsewhere(machine.stop, tried.clock)):
            machine.open()
            tried.stays_still("before it was enabled")
            machine.enable()
            tried.stays_still("when it was enabled and not commanded")
            tried.moves()
            stop()
            tried.watch(WATCHED // 5)
            tried.stays_still("after stop")
            if any(type(count) is not int for count in machine.counters().values()):
                _fail(machine, f"counters {machine.counters()}", "each is a whole number by name")
            machine.close()
            machine.close()
            machine.stop()
    finally:
        machine.stop()
        machine.close()


class _Tried:
    def __init__(self, machine: Machine, pace: Pace) -> None:
        self._machine, self._pace, self.clock = machine, pace, pace.clock
        self._last: Sample | None = None

    def watch(self, ticks: int) -> list[Sample]:
        """So many readings, each of which must make sense."""
        machine, clock = self._machine, self._pace.clock
        self._pace.start()
        samples, took = [], []
        for _ in range(ticks):
            self._pace.wait()
            began = clock()
            sample = machine.read()
            took.append(clock() - began)
            self._check(sample, clock())
            self._last = sample
            samples.append(sample)
        if sorted(took)[len(took) // 2] > QUICK_S:
            _fail(machine, f"read takes {1e3 * sorted(took)[len(took) // 2]:.0f} ms", "it waits a few at most")
        if samples[-1].time <= samples[0].time or samples[-1].force_time <= samples[0].force_time:
            _fail(machine, "its times stand still", "each is the moment of its reading, by time.monotonic")
        return samples

    def stays_still(self, when: str) -> None:
        """Over a while."""
        angles = [sample.angle for sample in self.watch(WATCHED // 2)]
        if max(angles) - min(angles) > STILL_RAD:
            way = max(angles) - min(angles)
            _fail(self._machine, f"moved by {way:.3f} rad {when}", "it moves under a command and while enabled only")

    def moves(self) -> None:
        """On a command, and is on its way when this returns."""
        machine = self._machine
        limits = machine.limits
        start = machine.read().angle
        up = start < (limits.angle_min + limits.angle_max) / 2
        velocity = limits.velocity_min or min(0.5, limits.velocity_max)
        machine.command(Target(start + (STEP_RAD if up else -STEP_RAD), velocity))
        gone = [sample.angle - start for sample in self.watch(WATCHED)]
        if (gone[-1] if up else -gone[-1]) < NOTICED_RAD:
            where = f"{gone[-1]:.3f} rad after {WATCHED / 100:g} s"
            _fail(machine, f"went {where}, commanded {STEP_RAD if up else -STEP_RAD} rad", "a command moves it")
        machine.command(Target(limits.angle_max if up else limits.angle_min, velocity))
        self.watch(WATCHED // 10)

    def _check(self, sample: Any, now: float) -> None:
        machine, last = self._machine, self._last
        if not isinstance(sample, Sample):
            _fail(machine, f"read returns {type(sample).__name__}", "it returns a softfin.rig.machine.Sample")
        if sample.complaints:
            _fail(machine, f"complains: {sample.complaints[0]}", "see to that first")
        numbers = (sample.time, sample.angle, sample.velocity, sample.force_time, *sample.wrench)
        if not all(abs(number) < float("inf") for number in numbers):
            _fail(machine, f"a reading is no finite number ({sample})", "all are, or complaints tell")
        for what, at, before in (
            ("time", sample.time, last and last.time),
            ("force_time", sample.force_time, last and last.force_time),
        ):
            if not now - STALE_S <= at <= now + 1e-6:
                _fail(machine, f"{what} is {now - at:.3f} s ago", f"0 to {STALE_S:g} s, by time.monotonic")
            if before is not None and at < before:
                _fail(machine, f"{what} went back by {before - at:.4f} s", "times rise")


def _elsewhere(stop: Callable[[], None], clock: Clock) -> None:
    clock.spawn(stop, "stop").join(5.0)


def _fail(machine: Any, what: str, asked: str) -> NoReturn:
    raise RigError(f"{getattr(machine, 'name', type(machine).__name__)}: {what}; {asked}")
