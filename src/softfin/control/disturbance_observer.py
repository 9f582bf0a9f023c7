"""A slow outer loop about any controller: the steady-state force error is measured and taken off the reference.

A bias of the surrogate, a softer fin or colder water shows as a difference between the mean force over the window and
the mean of the references that the inner controller got over the same window. That difference, smoothed, is subtracted
from the reference: a disturbance observer (Ohnishi 1987; Sariyildiz, Oboe and Ohnishi 2020), which is integral action
that knows its own output, so the window's delay does not destabilise it. The inner reference stays within the
controller's cells and the reachable forces, so the observer does not wind up at their edge.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from softfin.control.controller import STATIC, Controller, Measured, register_pytrees
from softfin.control.references import cells_of, reachable_of
from softfin.core.action_clock import ACTION_TICKS, CYCLE_ACTIONS, WINDOW
from softfin.core.configuration import Configuration
from softfin.core.operations import NUMPY, Array, Number, operations_of
from softfin.core.quantities import Command, Limits
from softfin.gaits.reachable import Cell, Force, Reachable, bounding_box

WINDOW_WEIGHTS = np.array(
    [[ACTION_TICKS[(age - 1 - ago) % 3] / WINDOW for ago in range(CYCLE_ACTIONS)] for age in range(3)]
)
"""Parts of the window of the last six actions, the newest first, at an age that is 0, 1 or 2 beyond a multiple of 3."""


class DisturbanceObserverConfig(Configuration):
    """Configuration of the disturbance observer."""

    gain: float = Field(default=0.15, gt=0, le=1)
    """Part of the difference that is taken over each action; 0.15 forgets within 2 s."""
    lag_actions: int = Field(default=1, ge=0, le=6)
    """Actions until the force follows the reference; the window of references is that much older."""
    settle_actions: int = Field(default=8, ge=6)
    """Actions from rest during which nothing is learnt: the fin is still starting."""
    still_n: PositiveFloat = 0.1
    """The reference counts as constant while it moves by less than this within the window [N]; beyond, the gain falls
    with the square."""
    limit_n: PositiveFloat = 1.0
    """Limit of the correction of each axis [N]."""

    @model_validator(mode="after")
    def _window_is_full(self) -> "DisturbanceObserverConfig":
        least = CYCLE_ACTIONS + self.lag_actions
        if self.settle_actions < least:
            raise ValueError(
                f"settle_actions = {self.settle_actions} with lag_actions = {self.lag_actions}: before {least} actions "
                f"the window of references is not full; give settle_actions {least} or more"
            )
        return self


class DisturbanceObserverState(NamedTuple):
    """State of the observer and of the controller inside; series have the newest first."""

    bias: Array
    """Estimated steady-state force error (x, y) [N]."""
    inner: Any
    """State of the controller inside."""
    forces: Array
    """Mean force while each of the last six actions was held ``(6, 2)`` [N]."""
    tracked: Array
    """Corrected references of the last actions [N]."""
    references: Array
    """References of the last actions as they were asked for [N]."""
    age: Number
    """Actions since the start."""


@dataclass(frozen=True)
class DisturbanceObserver:
    """A controller with the outer loop about it; meets the Controller contract, as the one inside does."""

    controller: Any
    """The Controller inside."""
    config: DisturbanceObserverConfig = field(default=DisturbanceObserverConfig(), metadata=STATIC)

    def __post_init__(self) -> None:
        register_pytrees(type(self))

    @property
    def limits(self) -> Limits:
        """Limits of the controller inside."""
        limits: Limits = self.controller.limits
        return limits

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Cells of the controller inside."""
        return cells_of(self.controller)

    @property
    def reachable(self) -> Reachable | None:
        """Reachable forces that the controller inside knows."""
        return reachable_of(self.controller)

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray] | None:
        if not self.cells:
            return None
        box = bounding_box(self.cells)
        return np.array(box.low, np.float32), np.array(box.high, np.float32)

    def init(self) -> DisturbanceObserverState:
        """Return the state of a fin at rest, with no bias."""
        controller: Controller = self.controller
        series = np.zeros((CYCLE_ACTIONS + self.config.lag_actions, 2))
        return DisturbanceObserverState(np.zeros(2), controller.init(), series[:CYCLE_ACTIONS], series, series, 0)

    def act(
        self, state: DisturbanceObserverState, measured: Measured, reference: Any
    ) -> tuple[DisturbanceObserverState, Command]:
        """Act with the controller inside on the reference less the bias."""
        ops, config = operations_of(*measured, reference, state.bias), self.config
        xp = ops.xp
        force, reference = xp.asarray(measured.force), xp.asarray(reference)
        forces = xp.concatenate([force[None], state.forces[:-1]])
        weights = ops.row(ops.constant(WINDOW_WEIGHTS), state.age % len(ACTION_TICKS))
        error = ops.dot(weights, forces - state.tracked[-CYCLE_ACTIONS:])
        # While the reference moves, the fin's own lag looks like a bias: then little is learnt. The correction's own
        # motion, which is slow, does not count: it would hold itself up.
        moved = (state.references.max(axis=0) - state.references.min(axis=0)).max()
        trust = xp.minimum(1, config.still_n / xp.maximum(moved, 1e-6))
        gain = ops.choose(state.age >= config.settle_actions, lambda: config.gain * trust**2, lambda: 0.0)
        bias = state.bias + gain * (error - state.bias)
        bias = xp.maximum(xp.minimum(bias, config.limit_n), -config.limit_n)
        tracked = reference - bias
        if self._box is not None:
            tracked = xp.maximum(xp.minimum(tracked, self._box[1]), self._box[0])
        if self.reachable is not None:
            tracked = self.reachable.project(tracked)
        inner, command = self.controller.act(
            state.inner, measured, tuple(tracked.tolist()) if ops is NUMPY else tracked
        )
        return DisturbanceObserverState(
            bias,
            inner,
            forces,
            xp.concatenate([tracked[None], state.tracked[:-1]]),
            xp.concatenate([reference[None], state.references[:-1]]),
            state.age + 1,
        ), command

    def check(self, reference: Force) -> None:
        """Raise CoverageError where the controller inside does."""
        controller: Controller = self.controller
        controller.check(reference)
