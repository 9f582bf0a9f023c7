"""Gaits: six actions, again and again. What one does to a plant, and the families that a search begins with.

Six actions on the 33/33/34 clock fill the window of the moving average exactly, so in the steady state a gait leaves no
ripple in it. A gait here is actions ``(6, 2)`` in [-1, 1], (angle, velocity) over the plant's limits.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.action_clock import CYCLE_ACTIONS, WINDOW
from softfin.plant import Plant, hold
from softfin.quantities import AnyArray
from softfin.tracking.reward import sobolev_mean
from softfin.tracking.task import command_of

Gait: TypeAlias = Float[AnyArray, "6 2"]

WAVES: dict[str, Sequence[float]] = {
    "two": (1, -1, 1, -1, 1, -1),
    "three": (1, -1, -1, 1, -1, -1),
    "six": (1, 0.5, -0.5, -1, -0.5, 0.5),
}
"""Angles of one gait about its centre, in units of its amplitude: strokes of 0.67 s, 1 s and 2 s."""

CENTRES = np.linspace(-1, 1, 11)
AMPLITUDES = np.linspace(0.05, 0.9, 7)
VELOCITIES = (1.0, 0.3, -0.3)


class Made(NamedTuple):
    """What a gait does when it has gone on for a while."""

    force: Float[Array, "2"]
    """Mean over the last window [N]."""
    smoothness: Float[Array, "2"]
    """Its Sobolev term in the form `mean` [N]."""


def made(plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray) -> Made:
    """Of a gait that is repeated from rest; the last of `cycles` counts."""
    return measured(steady(plant, gait, cycles, key))


def steady(plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray) -> Float[Array, "ticks 2"]:
    """Forces [N] of a gait that is repeated from rest."""
    actions = jnp.tile(jnp.asarray(gait), (cycles, 1))
    commands = jax.vmap(lambda action: command_of(plant.limits, action))(actions)
    return jnp.asarray(hold(plant, plant.init(key), commands)[1].force)


def measured(force: Float[Array, "ticks 2"]) -> Made:
    """Of the last window of a force."""
    last = force[-WINDOW:]
    return Made(last.mean(axis=0), sobolev_mean(last, jnp.int32(WINDOW)))


class Family(NamedTuple):
    """Gaits of one wave and one velocity, over all centres and amplitudes."""

    wave: str
    velocity: float
    gaits: Float[np.ndarray, "members 6 2"]


def families() -> list[Family]:
    """All that a survey tries: within one family, neighbouring forces come from neighbouring gaits."""
    found = []
    for (name, wave), velocity in product(WAVES.items(), VELOCITIES):
        angles = np.array([c + a * np.array(wave) for c, a in product(CENTRES, AMPLITUDES)])
        angles = np.clip(angles, -1, 1)
        gaits = np.stack([angles, np.full_like(angles, velocity)], axis=-1)
        assert gaits.shape[1] == CYCLE_ACTIONS
        found.append(Family(name, velocity, gaits.astype(np.float32)))
    return found


def differentiable(plant: Plant) -> bool:
    """Whether the mean force has a slope against the commands; one's own simulator may have none, or fail."""

    def force(gait: Gait) -> Float[Array, ""]:
        return made(plant, gait, 2, jax.random.key(0)).force.sum()

    gait = jnp.asarray(families()[0].gaits[len(CENTRES) * len(AMPLITUDES) // 2])
    try:
        slope = jax.jit(jax.grad(force))(gait)
    except Exception:
        # It is the user's code that is differentiated here, and it may fail in any way.
        return False
    return bool(jnp.isfinite(slope).all() and (slope != 0).any())
