"""The Controller contract: reference force in, command out, three times a second; pure and traceable like a plant."""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Float, PyTree

from softfin.core.quantities import Command

ControllerState: TypeAlias = PyTree[Any]


class Measured(NamedTuple):
    """What a controller may know of the fin when it acts."""

    angle: Float[Array, ""]
    """Of the shaft, the last reading [rad]; 0 before the first."""
    force: Float[Array, "2"]
    """(x, y), mean of the readings since the last action [N]; 0 before the first."""


@runtime_checkable
class Controller(Protocol):
    """Holds a reference force by commanding one fin; deterministic, no batch axes (`jax.vmap` adds them)."""

    def init(self) -> ControllerState:
        """The state before the first action: the fin at rest, nothing remembered."""
        ...

    def act(
        self, state: ControllerState, measured: Measured, reference: Float[Array, "2"]
    ) -> tuple[ControllerState, Command]:
        """The next action, from what was measured and the reference force (x, y) [N]."""
        ...

    def check(self, reference: tuple[float, float]) -> None:
        """Raise CoverageError where `reference` [N] is outside what the controller was trained for."""
        ...
