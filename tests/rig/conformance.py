"""Whether a machine meets the Machine contract: it is tried out, with its fin free to move."""

from typing import Any, NoReturn

import numpy as np

from softfin.core.errors import RigError
from softfin.rig.machine import Machine, Sample, Target, machine_clock
from softfin.rig.pace import Pace

STEP_RAD = 0.2
"""Step by which the fin is moved, towards the middle of its range [rad]; a quarter of it within 1 s
is a movement."""

STILL_RAD = 0.02
"""Angle within which a fin has stayed still [rad]."""

STALE_S = 0.2
"""Greatest age of a reading [s]."""

QUICK_S = 0.02
"""Longest that `read` may take in the median [s]."""


def check_machine(machine: Any) -> None:
    """Raise RigError, with what is wrong and what is asked, unless `machine` meets the contract;
    THE FIN MOVES.

    Checked: the members, that it stays still until it is enabled and then holds, that readings are
    finite, fresh and in order, that a command moves it, that a stop from this and from another
    thread ends it, that stop and close may be called at any time and again, and that it opens anew.
    It takes some seconds.
    """
    if not isinstance(machine, Machine):
        members = [name for name in dir(Machine) if not name.startswith("_")]
        missing = [name for name in members if not hasattr(machine, name)]
        _fail(machine, f"has no {', '.join(missing)}", "softfin.rig.machine.Machine describes them")
    pace = Pace(machine_clock(machine))
    machine.stop()
    machine.close()
    try:
        for from_another_thread in (False, True):
            machine.open()
            _check_still(machine, pace, "before it was enabled")
            machine.enable()
            _check_still(machine, pace, "when it was enabled and not commanded")
            _check_moves(machine, pace)
            if from_another_thread:
                pace.clock.spawn(machine.stop, "stop").join(5.0)
            else:
                machine.stop()
            _watch(machine, pace, 20)
            _check_still(machine, pace, "after stop")
            machine.close()
            machine.close()
            machine.stop()
    finally:
        machine.stop()
        machine.close()


def _watch(machine: Machine, pace: Pace, ticks: int) -> list[float]:
    """Read so many samples, each of which must make sense; returns the angles."""
    pace.start()
    samples: list[Sample] = []
    durations = []
    for _ in range(ticks):
        pace.wait()
        began = pace.clock()
        sample: Any = machine.read()
        durations.append(pace.clock() - began)
        if not isinstance(sample, Sample):
            _fail(
                machine,
                f"read returns {type(sample).__name__}",
                "it returns a softfin.rig.machine.Sample",
            )
        if sample.complaints:
            _fail(machine, f"complains: {sample.complaints[0]}", "see to that first")
        if not np.isfinite(
            [sample.time, sample.angle, sample.velocity, sample.force_time, *sample.wrench]
        ).all():
            _fail(
                machine,
                f"a reading is not finite ({sample})",
                "all are, or complaints tell",
            )
        for name in ("time", "force_time"):
            age = pace.clock() - getattr(sample, name)
            if not -1e-6 <= age <= STALE_S:
                _fail(
                    machine, f"{name} is {age:.3f} s ago", f"0 to {STALE_S:g} s, by time.monotonic"
                )
            if samples and getattr(sample, name) < getattr(samples[-1], name):
                _fail(machine, f"{name} went back", "times rise")
        samples.append(sample)
    if (median := sorted(durations)[ticks // 2]) > QUICK_S:
        _fail(machine, f"read takes {1e3 * median:.0f} ms", "it waits a few at most")
    if samples[-1].time <= samples[0].time or samples[-1].force_time <= samples[0].force_time:
        _fail(
            machine, "its times stand still", "each is the moment of its reading, by time.monotonic"
        )
    return [sample.angle for sample in samples]


def _check_still(machine: Machine, pace: Pace, when: str) -> None:
    angles = _watch(machine, pace, 50)
    way = max(angles) - min(angles)
    if way > STILL_RAD:
        _fail(
            machine,
            f"moved by {way:.3f} rad {when}",
            "it moves under a command and while enabled only",
        )


def _check_moves(machine: Machine, pace: Pace) -> None:
    """Check that a command moves the fin, and leave it on its way."""
    limits = machine.limits
    start = machine.read().angle
    up = start < (limits.angle_min + limits.angle_max) / 2
    step = STEP_RAD if up else -STEP_RAD
    velocity = limits.velocity_min or min(0.5, limits.velocity_max)
    machine.command(Target(start + step, velocity))
    moved = _watch(machine, pace, 100)[-1] - start
    if moved / step < 0.25:
        _fail(
            machine, f"went {moved:.3f} rad after 1 s, commanded {step} rad", "a command moves it"
        )
    machine.command(Target(limits.angle_max if up else limits.angle_min, velocity))
    _watch(machine, pace, 10)


def _fail(machine: Any, what: str, asked: str) -> NoReturn:
    raise RigError(f"{getattr(machine, 'name', type(machine).__name__)}: {what}; {asked}")
