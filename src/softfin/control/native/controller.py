"""A controller at run time: NumPy alone, equal to the one that was trained, command for command."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from softfin.control.native.operations import NUMPY, Array, Operations
from softfin.control.native.trim import Acting, Trim, Trimmed, TrimSettings
from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.errors import RunError
from softfin.core.quantities import Limits
from softfin.gaits.region import Box, Pair, Region, admitted, least_box
from softfin.rig.machine import Target

MOST = 1e6
"""Measurements beyond it, or not numbers, are none [rad, N]."""


@runtime_checkable
class Step(Protocol):
    """One action of a controller in any library of the array API."""

    def init(self) -> Any:
        """The state before the first action: a named tuple of arrays and numbers."""
        ...

    def act(self, ops: Operations, state: Any, now: Array) -> tuple[Any, Array]:
        """The next state and the action in [-1, 1]^2, for `now` = angle [rad] and reference (x, y) [N]."""
        ...


class TrainingRange(NamedTuple):
    """Least and greatest that the surrogate's training data held; None where that is not known."""

    angle_rad: Pair | None
    velocity_rad_s: Pair | None
    force_x_n: Pair | None
    force_y_n: Pair | None


@dataclass(frozen=True)
class Untrimmed:
    """A step run by NumPy; meets the Acting contract."""

    step: Step

    def init(self) -> Any:
        """The state before the first action."""
        return self.step.init()

    def act(self, state: Any, angle: float, force: Pair, reference: Pair) -> tuple[Any, Array]:
        """The next action; controllers do not look at the force, their outer loop does."""
        return self.step.act(NUMPY, state, np.array((angle, *reference), np.float32))


@dataclass(frozen=True)
class NativeController:
    """Holds a reference force by commanding one fin; deterministic, and a function of its state alone."""

    name: str
    """Of its folder."""
    kind: str
    """``single``, ``grid`` or ``gaits``."""
    limits: Limits
    """Of the plant that it was trained in: its commands stay within them."""
    cells: tuple[Box, ...]
    """References that it was trained for [N]."""
    region: Region | None
    """Mean forces that the fin can make, where that is known."""
    training_range: TrainingRange | None
    """Of the data behind its surrogate, where that is known."""
    fin: str | None
    """The fin that it was trained for, where its data named one."""
    description: Mapping[str, Any]
    """All that ``controller.json`` says."""
    weights_sha256: str
    """Of the file of weights."""
    step: Step
    """What is inside, for whoever exports it."""
    acting: Acting
    """The step, with an outer loop about it or without."""
    action_rate_hz: float = ACTION_RATE_HZ

    def init(self) -> Any:
        """The state before the first action: the fin at rest, nothing remembered."""
        return self.acting.init()

    def act(self, state: Any, angle: float, force: Pair, reference: Pair) -> tuple[Any, Target]:
        """The next action, three times a second.

        Args:
            state: what the last call gave, at first that of `init`; it is not changed.
            angle: of the shaft, the last reading [rad]; 0 before the first.
            force: (x, y), mean of the readings since the last action [N]; 0 before the first.
            reference: force to hold [N]; see `admit`.

        Raises:
            RunError: a measurement or the reference is not a number; the state is as it was.
        """
        if not all(abs(number) <= MOST for number in (angle, *force, *reference)):
            raise RunError(
                f"{self.name}: angle {angle:g} rad, force ({force[0]:g}, {force[1]:g}) N, reference ({reference[0]:g}, "
                f"{reference[1]:g}) N: a controller acts on finite numbers alone; see what the drive and sensor say"
            )
        state, action = self.acting.act(state, angle, force, reference)
        return state, target_of(self.limits, float(action[0]), float(action[1]))

    def untrimmed(self) -> "NativeController":
        """The same controller without an outer loop."""
        return dataclasses.replace(self, acting=Untrimmed(self.step))

    def admit(self, reference: Pair, strict: bool) -> tuple[Pair, str | None]:
        """The reference to hold, and a warning where it is another: the nearest force that the fin can make.

        Raises CoverageError where the fin cannot make the reference and `strict`, or where the controller was not
        trained for it.
        """
        return admitted(self.cells, self.region, reference, strict)


def trimmed(controller: NativeController, settings: TrimSettings | None = None) -> NativeController:
    """The same controller with the slow outer loop about it."""
    loop = Trimmed(Untrimmed(controller.step), settings or Trim(), least_box(controller.cells), controller.region)
    return dataclasses.replace(controller, acting=loop)


def target_of(limits: Limits, angle: float, velocity: float) -> Target:
    """[-1, 1]^2 onto the limits."""
    return Target(
        _between(limits.angle_min, limits.angle_max, angle),
        _between(limits.velocity_min, limits.velocity_max, velocity),
    )


def _between(low: float, high: float, share: float) -> float:
    # Rounding must not lead out of the limits.
    return min(max(low + (share + 1) / 2 * (high - low), low), high)
