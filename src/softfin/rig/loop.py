"""Runs a controller on a machine. Actions follow the clock of the controller, and each is based on
the readings since the previous action.

References can come from the user, a topic, the rows of a file or any function that returns the
latest reference.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TypeAlias

import numpy as np

from softfin.control.controller import Controller, Measured, controller_clock
from softfin.control.feedback import Estimate, Feedback
from softfin.core.errors import SoftfinError
from softfin.core.power import electrical_power, tick_velocity
from softfin.core.quantities import RATE_HZ
from softfin.rig.machine import Sample, Target
from softfin.rig.safety import Trip
from softfin.rig.session import MeasuredForce, Session, in_one_line
from softfin.rig.shaft_torque import Drive, ShaftTorque

ReferenceSource: TypeAlias = Callable[[float], MeasuredForce]
"""Function that returns the reference [N] at a time since the start [s]; called once per action."""

ResolveReference = Callable[[MeasuredForce], tuple[MeasuredForce, str | None]]
"""Function that maps a reference to the tracked reference, with a warning if they differ; raises
CoverageError if the reference cannot be tracked."""


@dataclass(frozen=True)
class ActionResult:
    """The command of one action, and the samples taken during it."""

    reference: MeasuredForce
    target: Target
    samples: list[Sample]
    estimate: Estimate | None = None
    """Estimate of the feedback after this action; None without feedback."""
    power: tuple[float, float] = (math.nan, math.nan)
    """Mean mechanical and electrical power [W]; NaN if unknown."""


def run_controller(
    session: Session,
    controller: Controller,
    references: ReferenceSource,
    actions: int | None = None,
    zero: MeasuredForce = (0.0, 0.0),
    shaft_torque: ShaftTorque | None = None,
) -> Iterator[ActionResult]:
    """Run `actions` actions, or until a stop if it is None; the session must be active and the fin
    at rest.

    `zero` [N], measured by `Session.rest`, is subtracted from the forces passed to the controller.
    `shaft_torque` measures the torques (default: without warnings).
    """
    shaft_torque = shaft_torque or ShaftTorque(session, lambda line: None)
    shaft_torque.start()
    clock = controller_clock(controller)
    durations = clock.ticks
    state = controller.init()
    last = session.newest or session.tick()
    angle = last.angle
    force = (0.0, 0.0)
    torques: tuple[Drive | None, Drive | None] = (None, None)
    ticks = 0
    for index in count() if actions is None else range(actions):
        try:
            reference = references(ticks / RATE_HZ)
            state, command = controller.act(state, Measured(angle, force, *torques), reference)
            target = Target(float(command.angle), float(command.velocity))
        except Exception as error:
            session.abort(Trip("controller", in_one_line(error, "the controller failed")))
        session.record_reference(reference)
        samples = session.hold(target, durations[index % len(durations)])
        ticks += len(samples)
        angle = samples[-1].angle
        x, y = shaft_torque.force(samples, clock.window_actions)
        force = (x - zero[0], y - zero[1])
        torques = shaft_torque.means(samples)
        found = controller.estimate(state) if isinstance(controller, Feedback) else None
        if found is not None and session.recorder is not None:
            force_n = found.force.tolist()
            half_width_n = found.half_width.tolist()
            level = float(found.level)
            session.recorder.estimate(session.pace.clock(), force_n, half_width_n, level)
        mechanical = math.nan if torques[0] is None else torques[0][1]
        electrical = _electrical_power(session, last, samples)
        yield ActionResult(reference, target, samples, found, (mechanical, electrical))
        last = samples[-1]


def _electrical_power(session: Session, last: Sample, samples: Sequence[Sample]) -> float:
    """Return the mean electrical power over the samples after the last one [W]; NaN if a current is
    missing or the motor is unknown."""
    # Only a rig has a configured drive.
    motor = getattr(session.machine, "motor", None)
    current = np.array([each.current for each in samples], float)
    if motor is None or not np.isfinite(current).all():
        return math.nan
    velocity = tick_velocity(np.array([each.velocity for each in (last, *samples)]))[1:]
    return float(electrical_power(current, velocity, motor).mean())


class LiveReference:
    """The latest reference from the user or a topic, which any thread may set. References that
    cannot be tracked are ignored."""

    def __init__(
        self, first: MeasuredForce, resolve: ResolveReference, report: Callable[[str], None]
    ) -> None:
        self._resolve = resolve
        self._report = report
        self._force, warning = resolve(first)
        if warning:
            report(warning)

    def __call__(self, at: float) -> MeasuredForce:
        """Return the latest reference [N]."""
        return self._force

    def set_from_text(self, text: str) -> None:
        """Track the force typed as a line in the terminal, e.g. ``2,-1``."""
        try:
            x, y = (float(part) for part in text.split(","))
            # The pair is assigned atomically, so no lock is needed.
            self._force, warning = self._resolve((x, y))
        except ValueError:
            warning = (
                f"{text!r}: not a reference; type X,Y in newtons, e.g. 2,-1, or press Enter to "
                "stop the fin"
            )
        except SoftfinError as error:
            warning = f"{error}; the reference is unchanged"
        if warning:
            self._report(warning)


def recorded_reference(
    time: Sequence[float],
    force: Sequence[MeasuredForce],
    resolve: ResolveReference,
    report: Callable[[str], None],
) -> ReferenceSource:
    """Return a source of the references in the rows of a file, each valid from its time onwards.
    All references are resolved now, before anything moves."""
    resolved = [resolve(each) for each in force]
    warnings = [warning for _, warning in resolved if warning is not None]
    if warnings:
        report(warnings[0] + (f" (and {len(warnings) - 1} more rows)" if len(warnings) > 1 else ""))
    # With the tolerance, a row applies at its own time despite rounding.
    return lambda at: resolved[max(0, bisect_right(time, at + 1e-6) - 1)][0]
