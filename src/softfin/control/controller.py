"""The interface of a controller, which turns a reference force into a command three times per
second.

The same controller runs with NumPy on a robot, without JAX, and as a pytree in JAX programs.
"""

import dataclasses
import reprlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np

from softfin.control.references import check_within
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import RunError
from softfin.core.operations import NUMPY, Array, Operations, select_operations
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.gaits.reachable import Cells, ForceVector, Reachable, format_force

ControllerState: TypeAlias = Any

Pair: TypeAlias = tuple[float, float]

MAX_MEASUREMENT = 1e6
"""Magnitude above which a measurement is treated as invalid [rad, N]."""


class Measured(NamedTuple):
    """Measurements available to a controller when it acts."""

    angle: Array
    """Latest reading of the shaft angle [rad]; 0 before the first reading."""
    force: Array
    """Mean force (x, y) since the last action [N]; 0 before the first action."""
    shaft: Array | None = None
    """Mean torque on the fin about the shaft [N m] and mean power delivered to the fin [W] since
    the last action; None if not measured. Torques are positive towards positive angles."""
    motor: Array | None = None
    """Mean torque [N m] and mean power [W] of the motor since the last action, at the output of the
    gearbox and computed from the motor current; None if not measured."""


@runtime_checkable
class Controller(Protocol):
    """Interface of a controller, which commands one fin so that its mean force tracks a reference.

    It is deterministic and has no batch axes; `jax.vmap` adds them. Two optional attributes define
    which references it can hold: the `cells` that it was trained for, and the `reachable` forces.
    """

    def init(self) -> ControllerState:
        """Return the state before the first action: the fin at rest."""
        ...

    def act(
        self, state: ControllerState, measured: Measured, reference: object
    ) -> tuple[ControllerState, Command]:
        """Compute the next state and command for a reference force (x, y) [N]."""
        ...

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the controller was not trained for the reference [N]."""
        ...


@runtime_checkable
class ControllerStep(Protocol):
    """Interface of the step of one kind of controller; steps are implemented with `Operations`."""

    kind: str

    def init(self) -> Any:
        """Return the state before the first action: a named tuple of arrays and numbers."""
        ...

    def act(self, ops: Operations, state: object, now: Array) -> tuple[Any, Array]:
        """Compute the next state and the action in [-1, 1]^2; `now` is (angle [rad], reference x,
        reference y [N])."""
        ...


class TrainingRange(NamedTuple):
    """Range of the readings in the surrogate's training data; None if unknown."""

    angle_rad: Pair | None
    velocity_rad_s: Pair | None
    force_x_n: Pair | None
    force_y_n: Pair | None


@dataclasses.dataclass(frozen=True)
class Artifact:
    """Origin of a controller."""

    name: str = "controller"
    """Name of the folder."""
    training_range: TrainingRange | None = None
    fin: str | None = None
    """Name of the fin for which it was trained, if known."""
    description: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Content of ``controller.json``."""
    weights_sha256: str = ""


STATIC: Mapping[str, bool] = MappingProxyType({"static": True})
"""Metadata of a field without arrays, which is a constant in compiled programs."""

DROPPED: Mapping[str, bool] = MappingProxyType({"dropped": True})
"""Metadata of a field that JAX ignores; in copies made by JAX, the field has its default value."""


@dataclasses.dataclass(frozen=True)
class LoadedController:
    """A controller of any kind, loaded from a folder; implements `Controller`."""

    step: ControllerStep
    limits: Limits = dataclasses.field(metadata=STATIC)
    """Limits of the plant on which the controller was trained; its commands never exceed them."""
    cells: Cells = dataclasses.field(metadata=STATIC)
    """References for which the controller was trained [N]."""
    reachable: Reachable | None = None
    """Reachable mean forces of the fin, if known."""
    # Not static: otherwise, each origin would need its own compiled program, and a program that
    # returns a controller would return the origin with which it was compiled.
    artifact: Artifact = dataclasses.field(default=Artifact(), metadata=DROPPED)
    clock: ActionClock = dataclasses.field(default=PAPER_CLOCK, metadata=STATIC)

    @property
    def kind(self) -> str:
        """Kind of the controller: single, grid or gaits."""
        return self.step.kind

    def init(self) -> Any:
        """Return the state before the first action: the fin at rest."""
        return self.step.init()

    def act(
        self, state: ControllerState, measured: Measured, reference: Array
    ) -> tuple[ControllerState, Command]:
        """Compute the next state and command: JAX arrays for JAX inputs, otherwise numbers.

        Raises:
            RunError: If a measurement or the reference is not finite (not checked under JAX), or
                has a different shape.
        """
        try:
            angle, force = measured[:2]
        except (TypeError, ValueError):
            raise self._malformed(measured, reference) from None
        ops = select_operations(angle, reference, state[0])
        if ops is not NUMPY:
            xp = ops.xp
            now = xp.concatenate([xp.asarray(angle)[None], xp.asarray(reference)])
            now = now.astype(np.float32)
            state, action = self.step.act(ops, state, now)
            return state, action_to_command(self.limits, action)
        try:
            inputs = (angle, *force, *reference)
        except TypeError:
            raise self._malformed(measured, reference) from None
        # NaN fails the comparison as well.
        if not all(abs(number) <= MAX_MEASUREMENT for number in inputs):
            raise RunError(
                f"{self.artifact.name}: angle {angle:g} rad, force {format_force(force)} N, "
                f"reference {format_force(reference)} N: inputs must be finite numbers; check the "
                "drive and the sensor"
            )
        state, action = self.step.act(ops, state, np.array((angle, *reference), np.float32))
        command: Any = action_to_command(self.limits, action.tolist())
        limits = self.limits
        # The conversion from [-1, 1] may round to just outside the limits.
        angle = ops.clip(command.angle, limits.angle_min, limits.angle_max)
        velocity = ops.clip(command.velocity, limits.velocity_min, limits.velocity_max)
        return state, Command(angle, velocity)

    def _malformed(self, measured: object, reference: object) -> RunError:
        return RunError(
            f"{self.artifact.name}: measured = {reprlib.repr(measured)}, reference = "
            f"{reprlib.repr(reference)}: must be (angle, (force_x, force_y)) and (x, y)"
        )

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the reference [N] is outside every cell."""
        check_within(self.cells, reference)


def controller_clock(controller: object) -> ActionClock:
    """Return the clock of a controller, or the paper's clock if the controller has no `clock`."""
    return getattr(controller, "clock", PAPER_CLOCK)
