"""A slow outer loop about any controller: what the fin makes besides what it was asked for is measured and subtracted.

A bias of the surrogate, a softer fin or colder water shows as a difference between the mean force over the window and
the mean of what the inner controller was asked for over the same window. That difference, smoothed, is taken off the
reference: a disturbance observer (Ohnishi 1987; Sariyildiz, Oboe and Ohnishi 2020), which is integral action whose
integrator knows what was really asked. So the window's delay does not destabilise it. What is asked stays within the
inner controller's range and, where it is known, the fin's reach: held back at their edge, the trim does not wind up.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from pydantic import Field, PositiveFloat, model_validator

from softfin.control.controller import Controller, ControllerState, Measured
from softfin.control.range import cells_of, reachable_of
from softfin.core.action_clock import ACTION_TICKS, CYCLE_ACTIONS, WINDOW
from softfin.core.configuration import Configuration
from softfin.core.quantities import Command
from softfin.gaits.reachable import Reachable
from softfin.task.references import Cell, Force, bounding_box


class TrimConfig(Configuration):
    """The outer loop."""

    gain: float = Field(default=0.15, gt=0, le=1)
    """Part of the difference that is taken over each action; 0.15 forgets within 2 s."""
    lag_actions: int = Field(default=1, ge=0, le=6)
    """Actions until the force follows what was asked; the window of what was asked is that much older."""
    settle_actions: int = Field(default=8, ge=6)
    """Actions from rest during which nothing is learnt: the fin is still starting."""
    still_n: PositiveFloat = 0.1
    """The reference counts as at rest while it moves by less than this within the window [N]; beyond, the gain falls
    with the square."""
    limit_n: PositiveFloat = 1.0
    """The trim of each axis stays within this [N]."""

    @model_validator(mode="after")
    def _remembers(self) -> "TrimConfig":
        least = CYCLE_ACTIONS + self.lag_actions
        if self.settle_actions < least:
            raise ValueError(
                f"settle_actions = {self.settle_actions} with lag_actions = {self.lag_actions}: before {least} actions "
                f"the window of what was asked is not full; give settle_actions {least} or more"
            )
        return self


class TrimState(NamedTuple):
    """Of the loop and of what is inside it."""

    inner: ControllerState
    bias: Float[Array, "2"]
    """What the fin makes besides what is asked [N]."""
    forces: Float[Array, "6 2"]
    """Mean force while each of the last six actions was held, the newest first [N]."""
    asked: Float[Array, "remembered 2"]
    """What the inner controller was asked for then, the newest first [N]."""
    wanted: Float[Array, "remembered 2"]
    """The references then, untrimmed [N]."""
    age: Int[Array, ""]
    """Actions since the start."""


class TrimmedController(eqx.Module):
    """Meets the Controller contract."""

    inner: Any
    """A Controller."""
    config: TrimConfig = eqx.field(static=True)
    cells: tuple[Cell, ...] = eqx.field(static=True)
    """Those of the inner controller, looked up here: within a compiled program a gait's lattice has no numbers."""

    def __init__(self, inner: Controller, config: TrimConfig) -> None:
        self.inner, self.config, self.cells = inner, config, cells_of(inner)

    def init(self) -> TrimState:
        """Nothing known of any bias."""
        inner: Controller = self.inner
        asked = jnp.zeros((CYCLE_ACTIONS + self.config.lag_actions, 2))
        return TrimState(inner.init(), jnp.zeros(2), jnp.zeros((CYCLE_ACTIONS, 2)), asked, asked, jnp.int32(0))

    def act(self, state: TrimState, measured: Measured, reference: Float[Array, "2"]) -> tuple[TrimState, Command]:
        """The inner controller's action for the reference less the bias."""
        forces = jnp.concatenate([jnp.asarray(measured.force)[None], state.forces[:-1]])
        # Ticks of the last six actions, newest first: the action before this one was number age - 1.
        held = jnp.array(ACTION_TICKS)[(state.age - 1 - jnp.arange(CYCLE_ACTIONS)) % len(ACTION_TICKS)]
        weight = (held / WINDOW)[:, None]
        surplus = (weight * (forces - state.asked[-CYCLE_ACTIONS:])).sum(axis=0)
        # While the reference moves, the fin's own lag looks like a bias: then little is learnt. The trim's own motion,
        # which is slow, does not count: it would hold itself up.
        moved = jnp.ptp(state.wanted, axis=0).max()
        trusted = jnp.minimum(1, self.config.still_n / jnp.maximum(moved, 1e-6))
        gain = jnp.where(state.age >= self.config.settle_actions, self.config.gain * trusted**2, 0.0)
        limit = self.config.limit_n
        bias = jnp.clip(state.bias + gain * (surplus - state.bias), -limit, limit)
        reference = jnp.asarray(reference)
        asked = self.within(reference - bias)
        inner, command = self.inner.act(state.inner, measured, asked)
        remembered = jnp.concatenate([asked[None], state.asked[:-1]])
        wanted = jnp.concatenate([reference[None], state.wanted[:-1]])
        return TrimState(inner, bias, forces, remembered, wanted, state.age + 1), command

    @property
    def reachable(self) -> Reachable | None:
        """That of the inner controller."""
        return reachable_of(self.inner)

    def within(self, reference: Float[Array, "2"]) -> Float[Array, "2"]:
        """The trimmed reference, brought back to the inner controller's range and the fin's reach, where known."""
        if self.cells:
            box = bounding_box(self.cells)
            reference = jnp.clip(reference, jnp.asarray(box.low), jnp.asarray(box.high))
        return reference if self.reachable is None else self.reachable.pulled(reference)

    def check(self, reference: Force) -> None:
        """As the inner controller."""
        inner: Controller = self.inner
        inner.check(reference)
