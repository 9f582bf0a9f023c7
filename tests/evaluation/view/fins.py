"""A fin that computes its shape without a tank's cost: an arc whose curvature goes with the shaft's
speed."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.quantities import Command, Reading
from softfin.core.randomness import named_key
from softfin.evaluation.view.footage import Footage, film
from softfin.evaluation.view.view import StrokeGaitConfig, stroke_gait
from tests.plants import AnalyticFin, FinState

LENGTH_M = 0.2


class BendingFin(AnalyticFin):
    """The analytic fin; its shape lags behind the shaft towards the tip."""

    def shape(self, state: FinState) -> Float[Array, "points 2"]:
        angles = state.angle * jnp.linspace(1.0, 0.7, 8)
        steps = LENGTH_M / 8 * jnp.stack([-jnp.cos(angles), jnp.sin(angles)], axis=-1)
        return jnp.concatenate([jnp.zeros((1, 2)), jnp.cumsum(steps, axis=0)])


class OffsetSensor(BendingFin):
    """Its sensor reads 3 N too much in x, and it knows the true force."""

    def init(self, key: PRNGKeyArray) -> Any:
        return super().init(key), jnp.zeros(2)

    def advance(self, state: Any, command: Command, ticks: int) -> tuple[Any, Reading]:
        fin, reading = super().advance(state[0], command, ticks)
        return (fin, reading.force[-1]), reading._replace(
            force=reading.force + jnp.array([3.0, 0.0])
        )

    def shape(self, state: Any) -> Float[Array, "points 2"]:
        return super().shape(state[0])

    def true_force(self, state: Any) -> Float[Array, "2"]:
        return jnp.asarray(state[1])


def beating(
    plant: AnalyticFin, ticks: int, reference: tuple[float, float] | None = None
) -> Footage:
    """Asked for a reference all the time."""
    commands: Command = stroke_gait(StrokeGaitConfig(), plant.limits, ticks)
    asked = None if reference is None else np.tile(np.float32(reference), (ticks, 1))
    return film(plant, named_key(0, "test"), commands, asked)
