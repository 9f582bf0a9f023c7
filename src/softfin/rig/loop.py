"""A controller on a machine: three actions a second on the 33/33/34 clock, each on what was measured since the last.

References come live, from a constant, a recorded signal or anything that can be asked for the newest one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol, TypeAlias, runtime_checkable

from softfin.control.controller import Measured
from softfin.core.action_clock import ACTION_TICKS
from softfin.core.errors import SoftfinError
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.rig.machine import Sample, Target
from softfin.rig.safety import Trip
from softfin.rig.session import Session

Force: TypeAlias = tuple[float, float]
"""(x, y) [N]."""

References: TypeAlias = Callable[[float], Force]
"""The reference [N] at so many seconds since the start, asked at each action."""


@runtime_checkable
class Acting(Protocol):
    """A controller with the limits of its commands: one of `softfin.load_controller`, or one's own."""

    @property
    def limits(self) -> Limits:
        """Its commands stay within these."""
        ...

    def init(self) -> Any:
        """The state before the first action."""
        ...

    def act(self, state: Any, measured: Measured, reference: Force) -> tuple[Any, Command]:
        """Compute the next state and command, as numbers, for a reference [N]."""
        ...


@dataclass(frozen=True)
class Held:
    """What one action led to."""

    reference: Force
    target: Target
    samples: list[Sample]


def hold(session: Session, controller: Acting, references: References, actions: int | None = None) -> Iterator[Held]:
    """Act so many times, or until somebody says stop; the session is active and its fin at rest."""
    state = controller.init()
    sample = session.newest or session.tick()
    angle, force = sample.angle, (0.0, 0.0)
    ticks = 0
    for index in count() if actions is None else range(actions):
        try:
            reference = references(ticks / RATE_HZ)
            state, command = controller.act(state, Measured(angle, force), reference)
            target = Target(float(command.angle), float(command.velocity))
        except SoftfinError as error:
            session.abort(Trip("controller", str(error)))
        except Exception as error:
            session.abort(Trip("controller", f"the controller failed ({type(error).__name__}: {error}); see --debug"))
        session.asked(reference)
        length = ACTION_TICKS[index % len(ACTION_TICKS)]
        samples = session.hold(target, length)
        ticks += length
        angle = samples[-1].angle
        force = (sum(s.wrench[0] for s in samples) / length, sum(s.wrench[1] for s in samples) / length)
        yield Held(reference, target, samples)


def seconds_to_actions(seconds: int) -> int:
    """Whole seconds in actions."""
    return seconds * len(ACTION_TICKS)
