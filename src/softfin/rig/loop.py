"""A controller on a machine: three actions a second on the 33/33/34 clock, each on what was measured since the last.

References come live, from a constant, a recorded signal or any function that returns the newest one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol, TypeAlias, runtime_checkable

from softfin.control.controller import Measured
from softfin.core.action_clock import ACTION_TICKS
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.rig.machine import Sample, Target
from softfin.rig.safety import Trip
from softfin.rig.session import Session, in_one_line

Force: TypeAlias = tuple[float, float]
"""Force (x, y) [N]."""

References: TypeAlias = Callable[[float], Force]
"""Function that returns the reference [N] at so many seconds since the start; called at each action."""


@runtime_checkable
class RealTimeController(Protocol):
    """A controller with the limits of its commands: one of `softfin.load_controller`, or one's own."""

    @property
    def limits(self) -> Limits:
        """Limits of its commands."""
        ...

    def init(self) -> Any:
        """Return the state before the first action."""
        ...

    def act(self, state: Any, measured: Measured, reference: Force) -> tuple[Any, Command]:
        """Compute the next state and command, as numbers, for a reference [N]."""
        ...


@dataclass(frozen=True)
class ActionResult:
    """The command of one action, and the samples while it was held."""

    reference: Force
    target: Target
    samples: list[Sample]


def run_controller(
    session: Session, controller: RealTimeController, references: References, actions: int | None = None
) -> Iterator[ActionResult]:
    """Act so many times, or until a stop; the session is active and its fin at rest."""
    state = controller.init()
    angle, force = (session.newest or session.tick()).angle, (0.0, 0.0)
    ticks = 0
    for index in count() if actions is None else range(actions):
        try:
            reference = references(ticks / RATE_HZ)
            state, command = controller.act(state, Measured(angle, force), reference)
            target = Target(float(command.angle), float(command.velocity))
        except Exception as error:
            session.abort(Trip("controller", in_one_line(error, "the controller failed")))
        session.record_reference(reference)
        length = ACTION_TICKS[index % len(ACTION_TICKS)]
        samples = session.hold(target, length)
        ticks += length
        angle, force = samples[-1].angle, mean_force(samples)
        yield ActionResult(reference, target, samples)


def mean_force(samples: list[Sample]) -> Force:
    """Return the mean force (x, y) of samples [N]."""
    return sum(s.wrench[0] for s in samples) / len(samples), sum(s.wrench[1] for s in samples) / len(samples)


def seconds_to_actions(seconds: int) -> int:
    """Return the number of actions in whole seconds."""
    return seconds * len(ACTION_TICKS)
