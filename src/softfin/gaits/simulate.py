"""Gaits simulated in a plant: mean force, Sobolev term and their gradients; and the families that a survey tries."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.action_clock import CYCLE_ACTIONS, WINDOW
from softfin.core.errors import RunError
from softfin.core.plant import Plant, hold
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AnyArray, command_of
from softfin.core.window import sobolev
from softfin.gaits.gait import Gait

WAVEFORMS: dict[str, Sequence[float]] = {
    "two": (1, -1, 1, -1, 1, -1),
    "three": (1, -1, -1, 1, -1, -1),
    "six": (1, 0.5, -0.5, -1, -0.5, 0.5),
}
"""Angles of a gait about its centre, in units of its amplitude: strokes of 0.67 s, 1 s and 2 s."""

CENTRES = np.linspace(-1, 1, 11)
AMPLITUDES = np.linspace(0.05, 0.9, 7)
VELOCITIES = (1.0, 0.3, -0.3)


class GaitResponse(NamedTuple):
    """Forces of a gait in the steady state."""

    force: Float[Array, "2"]
    """Mean force over the last window [N]."""
    smoothness: Float[Array, "2"]
    """Sobolev term of the last window in the form `mean` [N]."""


def simulate_gait(plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray) -> GaitResponse:
    """Repeat a gait from rest; the last of `cycles` windows counts."""
    last = steady_state_force(plant, gait, cycles, key)[-WINDOW:]
    return GaitResponse(last.mean(axis=0), sobolev(last, jnp.int32(WINDOW)))


def steady_state_force(plant: Plant, gait: Gait, cycles: int, key: PRNGKeyArray) -> Float[Array, "ticks 2"]:
    """Forces [N] of a gait that is repeated from rest."""
    actions = jnp.tile(jnp.asarray(gait), (cycles, 1))
    commands = jax.vmap(lambda action: command_of(plant.limits, action))(actions)
    return jnp.asarray(hold(plant, plant.init(key), commands)[1].force)


class Family(NamedTuple):
    """Gaits of one waveform and one velocity, over all centres and amplitudes."""

    waveform: str
    velocity: float
    gaits: Float[np.ndarray, "members 6 2"]


def families() -> list[Family]:
    """Return all that a survey tries: within one family, neighbouring forces come from neighbouring gaits."""
    found = []
    for (name, waveform), velocity in product(WAVEFORMS.items(), VELOCITIES):
        angles = np.array([c + a * np.array(waveform) for c, a in product(CENTRES, AMPLITUDES)])
        angles = np.clip(angles, -1, 1)
        gaits = np.stack([angles, np.full_like(angles, velocity)], axis=-1)
        found.append(Family(name, velocity, gaits.astype(np.float32)))
    return found


class GaitSensitivity(NamedTuple):
    """Mean forces and Sobolev terms of gaits, with their gradients."""

    pre_tanh: Float[AnyArray, "gaits 12"]
    """atanh of the actions."""
    out: Float[AnyArray, "gaits 3"]
    """Mean force (x, y) and the sum of both Sobolev terms [N]."""
    slope: Float[AnyArray, "gaits 3 12"]
    """Gradient of `out` by `pre_tanh`."""
    smoothness: Float[AnyArray, "gaits 2"]
    """Sobolev terms (x, y) [N]."""


GREATEST_ACTION = 0.97
"""Actions are moved through atanh, which has no value at 1."""


def pre_tanh_of(gaits: Float[np.ndarray, "gaits 6 2"]) -> Float[np.ndarray, "gaits 12"]:
    """Return the atanh of the actions."""
    pre_tanh: np.ndarray = np.arctanh(np.clip(gaits, -GREATEST_ACTION, GREATEST_ACTION)).reshape(len(gaits), -1)
    return pre_tanh


SIDE_BY_SIDE = 32
"""Gaits of one call of the program that finds their slopes: one size, so that all who ask share the program."""

CYCLES = 3
"""Windows that a gait is repeated for from rest, where nothing else is asked for."""


def gait_sensitivity(
    plant: Plant, pre_tanh: Float[AnyArray, "gaits 12"], cycles: int, key: PRNGKeyArray
) -> GaitSensitivity:
    """Simulate gaits and differentiate their forces; `plant` as `jit_argument` makes it."""
    count = len(pre_tanh)
    padded = np.resize(np.asarray(pre_tanh), (-(-count // SIDE_BY_SIDE) * SIDE_BY_SIDE, pre_tanh.shape[1]))
    parts = [
        _respond(plant, jnp.asarray(padded[start : start + SIDE_BY_SIDE]), cycles, key)
        for start in range(0, len(padded), SIDE_BY_SIDE)
    ]
    found: GaitSensitivity = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    return found


@eqx.filter_jit
def _respond(plant: Plant, pre_tanh: Float[Array, "gaits 12"], cycles: int, key: PRNGKeyArray) -> GaitSensitivity:
    def out(pre_tanh: Float[Array, "12"]) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
        got = simulate_gait(plant, jnp.tanh(pre_tanh).reshape(CYCLE_ACTIONS, 2), cycles, key)
        return jnp.concatenate([got.force, got.smoothness.sum()[None]]), got.smoothness

    def each(pre_tanh: Float[Array, "12"]) -> GaitSensitivity:
        value, pull, smoothness = jax.vjp(out, pre_tanh, has_aux=True)
        return GaitSensitivity(pre_tanh, value, jax.vmap(lambda way: pull(way)[0])(jnp.eye(3)), smoothness)

    found: GaitSensitivity = jax.vmap(each)(pre_tanh)
    return found


def missing_gradient(plant: Plant) -> str | None:
    """Explain why the force of a plant has no gradient with respect to its commands; None where it has one.

    Raises:
        PlantError: the plant itself fails.
        RunError: the computer fails, for want of memory for example.
    """
    gait = pre_tanh_of(families()[0].gaits[len(CENTRES) * len(AMPLITUDES) // 2][None])
    # Raises where the plant does not go forward.
    argument = jit_argument(plant)
    try:
        slope = gait_sensitivity(argument, gait, CYCLES, jax.random.key(0)).slope[:, :2]
    except (TypeError, ValueError, NotImplementedError) as error:
        # What JAX raises where there is no derivative.
        return f"JAX cannot differentiate it ({type(error).__name__}: {str(error).partition(chr(10))[0]})"
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        raise RunError(
            f"{type(plant).__name__}: whether its force has a gradient cannot be determined: "
            f"{str(error).partition(chr(10))[0] or 'no memory left'}; --algorithm ppo trains without gradients"
        ) from error
    if not np.isfinite(slope).all():
        return "its slope is not finite, as of a square root at 0"
    return None if slope.any() else "its slope is 0 throughout"
