"""Controllers: a reference force in, a command out, three times a second.

The same controller runs everywhere: with NumPy on a robot, where JAX is not imported, and as a
pytree in JAX programs.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np

from softfin.control.references import check_within
from softfin.core.errors import RunError
from softfin.core.jax_import import when_jax_is_imported
from softfin.core.operations import NUMPY, Array, Operations, select_operations
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.gaits.reachable import Cells, ForceVector, Reachable, format_force

ControllerState: TypeAlias = Any

Pair: TypeAlias = tuple[float, float]

MAX_MEASUREMENT = 1e6
"""Magnitude above which a measurement must be an error [rad, N]."""


class Measured(NamedTuple):
    """Measurements that a controller gets when it acts."""

    angle: Array
    """Last reading of the shaft's angle [rad]; 0 before the first."""
    force: Array
    """Mean force (x, y) of the readings since the last action [N]; 0 before the first."""


@runtime_checkable
class Controller(Protocol):
    """Holds a reference force by commanding one fin; deterministic, no batch axes (`jax.vmap` adds
    them).

    It may have `cells` that it was trained for and a `reachable` region, which tell which
    references it can hold.
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
        """Raise CoverageError if the reference [N] is outside the range for which the controller
        was trained."""
        ...


@runtime_checkable
class ControllerStep(Protocol):
    """One action of one kind of controller, written with `Operations`."""

    kind: str

    def init(self) -> Any:
        """Return the state before the first action: a named tuple of arrays and numbers."""
        ...

    def act(self, ops: Operations, state: object, now: Array) -> tuple[Any, Array]:
        """Compute the next state and the action in [-1, 1]^2; `now` is (angle [rad], reference x,
        reference y [N])."""
        ...


class TrainingRange(NamedTuple):
    """Smallest and largest reading in the data of a controller's surrogate; None if unknown."""

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
    """Name of the fin for which it was trained, if its data contain one."""
    description: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Content of ``controller.json``."""
    weights_sha256: str = ""


STATIC: Mapping[str, bool] = MappingProxyType({"static": True})
"""Metadata of a field without arrays: compiled programs contain it as a constant."""

DROPPED: Mapping[str, bool] = MappingProxyType({"dropped": True})
"""Metadata of a field that JAX does not see; a copy that JAX makes has the default."""


@dataclasses.dataclass(frozen=True)
class LoadedController:
    """A controller of any kind; meets the Controller contract."""

    step: ControllerStep
    limits: Limits = dataclasses.field(metadata=STATIC)
    """Limits of the plant in which it was trained; its commands stay within them."""
    cells: Cells = dataclasses.field(metadata=STATIC)
    """References for which it was trained [N]."""
    reachable: Reachable | None = None
    """Mean forces that the fin can make, if known."""
    # If it were static, each origin would need its own compiled program, and a program that returns
    # a controller would return the origin of the first one.
    artifact: Artifact = dataclasses.field(default=Artifact(), metadata=DROPPED)

    def __post_init__(self) -> None:
        register_pytrees(type(self), type(self.step))

    @property
    def kind(self) -> str:
        """Kind of the controller: single, grid or gaits."""
        return self.step.kind

    def init(self) -> Any:
        """Return the state before the first action: the fin at rest."""
        return self.step.init()

    def act(self, state: Any, measured: Measured, reference: Any) -> tuple[Any, Command]:
        """Compute the next state and command; for numbers and NumPy arrays it returns numbers, for
        JAX arrays JAX arrays.

        Raises:
            RunError: outside of JAX, a measurement or the reference is not a finite number; the
                state is unchanged.
        """
        angle, force = measured
        ops = select_operations(angle, reference, state[0])
        if ops is not NUMPY:
            xp = ops.xp
            now = xp.concatenate([xp.asarray(angle)[None], xp.asarray(reference)])
            now = now.astype(np.float32)
            state, action = self.step.act(ops, state, now)
            return state, action_to_command(self.limits, action)
        if not all(
            abs(measurement) <= MAX_MEASUREMENT for measurement in (angle, *force, *reference)
        ):
            raise RunError(
                f"{self.artifact.name}: angle {angle:g} rad, force {format_force(force)} N, "
                f"reference {format_force(reference)} N: a controller needs finite numbers; check "
                "drive and sensor"
            )
        state, action = self.step.act(ops, state, np.array((angle, *reference), np.float32))
        command: Any = action_to_command(self.limits, action.tolist())
        limits = self.limits
        # Rounding must not leave the limits.
        angle = ops.clip(command.angle, limits.angle_min, limits.angle_max)
        velocity = ops.clip(command.velocity, limits.velocity_min, limits.velocity_max)
        return state, Command(angle, velocity)

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the reference is outside every cell."""
        check_within(self.cells, reference)


def register_pytrees(*classes: type) -> None:
    """Make dataclasses pytrees of JAX: fields are leaves unless they are `STATIC` or `DROPPED`.

    Controllers may be loaded before JAX is imported, so a class is registered as soon as that
    happens.
    """
    for each in classes:
        if each not in _REGISTERED and dataclasses.is_dataclass(each):
            _REGISTERED.add(each)
            when_jax_is_imported(partial(_register_pytree, each))


_REGISTERED: set[type] = set()
"""Classes that are registered, or will be when JAX is imported."""


def _register_pytree(dataclass: type) -> None:
    import jax

    names: dict[str, list[str]] = {"leaf": [], "static": [], "dropped": []}
    for field in dataclasses.fields(dataclass):
        role = next(iter(field.metadata), "leaf")
        names[role].append(field.name)
    jax.tree_util.register_dataclass(dataclass, *names.values())
