"""Check whether a machine of one's own meets the Machine contract: it is tried out, with its fin free to move."""

from typing import Any, NoReturn

from softfin.core.errors import RigError
from softfin.rig.machine import Machine, Sample, Target, clock_of
from softfin.rig.pace import Pace

STEP_RAD = 0.2
"""Step by which the fin is moved, towards the middle of its range [rad]."""

MOVED_RAD = 0.05
"""Angle beyond which a fin has moved [rad]."""

STILL_RAD = 0.02
"""Angle within which a fin has stayed still [rad]."""

STALE_S = 0.2
"""Greatest age of a reading [s]."""

QUICK_S = 0.02
"""Longest that `read` may take in the median [s]."""


def check_machine(machine: Any, pace: Pace | None = None) -> None:
    """Raise RigError, with what is wrong and what is asked, unless `machine` meets the contract; THE FIN MOVES.

    Checked: the members, that it stays still until it is enabled and then holds, that readings are finite, fresh and in
    order, that a command moves it, that a stop from this and from another thread ends it, that stop and close may be
    called at any time and again, and that it opens anew. It takes some seconds.
    """
    if not isinstance(machine, Machine):
        members = [name for name in dir(Machine) if not name.startswith("_")]
        missing = [name for name in members if not hasattr(machine, name)]
        _fail(machine, f"has no {', '.join(missing)}", "softfin.rig.machine.Machine describes them")
    machine.stop()
    machine.close()
    trial = _Trial(machine, pace or Pace(clock=clock_of(machine)))
    try:
        for from_another_thread in (False, True):
            machine.open()
            trial.check_still("before it was enabled")
            machine.enable()
            trial.check_still("when it was enabled and not commanded")
            trial.check_moves()
            if from_another_thread:
                trial.pace.clock.spawn(machine.stop, "stop").join(5.0)
            else:
                machine.stop()
            trial.watch(20)
            trial.check_still("after stop")
            if any(type(count) is not int for count in machine.counters().values()):
                _fail(machine, f"counters {machine.counters()}", "each is a whole number by name")
            machine.close()
            machine.close()
            machine.stop()
    finally:
        machine.stop()
        machine.close()


class _Trial:
    def __init__(self, machine: Machine, pace: Pace) -> None:
        self.machine, self.pace = machine, pace
        self._last: Sample | None = None

    def watch(self, ticks: int) -> list[float]:
        """Read so many samples, each of which must make sense; returns the angles."""
        machine, clock = self.machine, self.pace.clock
        self.pace.start()
        samples, durations = [], []
        for _ in range(ticks):
            self.pace.wait()
            began = clock()
            sample = machine.read()
            durations.append(clock() - began)
            self._check(sample, clock())
            self._last = sample
            samples.append(sample)
        median = sorted(durations)[ticks // 2]
        if median > QUICK_S:
            _fail(machine, f"read takes {1e3 * median:.0f} ms", "it waits a few at most")
        if samples[-1].time <= samples[0].time or samples[-1].force_time <= samples[0].force_time:
            _fail(machine, "its times stand still", "each is the moment of its reading, by time.monotonic")
        return [sample.angle for sample in samples]

    def check_still(self, when: str) -> None:
        """Check that the fin does not move for half a second."""
        angles = self.watch(50)
        way = max(angles) - min(angles)
        if way > STILL_RAD:
            _fail(self.machine, f"moved by {way:.3f} rad {when}", "it moves under a command and while enabled only")

    def check_moves(self) -> None:
        """Check that a command moves the fin, and leave it on its way."""
        machine, limits = self.machine, self.machine.limits
        start = machine.read().angle
        up = start < (limits.angle_min + limits.angle_max) / 2
        step = STEP_RAD if up else -STEP_RAD
        velocity = limits.velocity_min or min(0.5, limits.velocity_max)
        machine.command(Target(start + step, velocity))
        moved = self.watch(100)[-1] - start
        if (moved if up else -moved) < MOVED_RAD:
            _fail(machine, f"went {moved:.3f} rad after 1 s, commanded {step} rad", "a command moves it")
        machine.command(Target(limits.angle_max if up else limits.angle_min, velocity))
        self.watch(10)

    def _check(self, sample: Any, now: float) -> None:
        machine, last = self.machine, self._last
        if not isinstance(sample, Sample):
            _fail(machine, f"read returns {type(sample).__name__}", "it returns a softfin.rig.machine.Sample")
        if sample.complaints:
            _fail(machine, f"complains: {sample.complaints[0]}", "see to that first")
        numbers = (sample.time, sample.angle, sample.velocity, sample.force_time, *sample.wrench)
        if not all(abs(number) < float("inf") for number in numbers):
            _fail(machine, f"a reading is not a finite number ({sample})", "all are, or complaints tell")
        for name in ("time", "force_time"):
            at = getattr(sample, name)
            if not now - STALE_S <= at <= now + 1e-6:
                _fail(machine, f"{name} is {now - at:.3f} s ago", f"0 to {STALE_S:g} s, by time.monotonic")
            if last is not None and at < getattr(last, name):
                _fail(machine, f"{name} went back by {getattr(last, name) - at:.4f} s", "times rise")


def _fail(machine: Any, what: str, asked: str) -> NoReturn:
    raise RigError(f"{getattr(machine, 'name', type(machine).__name__)}: {what}; {asked}")
