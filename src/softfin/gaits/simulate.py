"""Gaits simulated in a plant: mean force, Sobolev term, and their gradients."""

from collections.abc import Callable
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

Report = Callable[[float, str], None]
"""Called with the done part (0 .. 1) and a note."""

CYCLES = 3
"""Windows that a gait is repeated for from rest, where nothing else is asked for."""

GREATEST_ACTION = 0.97
"""Actions are moved through atanh, which has no value at 1."""

SIDE_BY_SIDE = 32
"""Gaits of one call of the program that finds their slopes: one size, so that all who ask share the program."""


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


def pre_tanh_of(gaits: Float[np.ndarray, "gaits 6 2"]) -> Float[np.ndarray, "gaits 12"]:
    """Return the atanh of the actions."""
    return np.asarray(np.arctanh(np.clip(gaits, -GREATEST_ACTION, GREATEST_ACTION)).reshape(len(gaits), -1))


def gait_sensitivity(
    plant: Plant, pre_tanh: Float[AnyArray, "gaits 12"], cycles: int, key: PRNGKeyArray
) -> GaitSensitivity:
    """Simulate gaits and differentiate their forces; `plant` as `jit_argument` makes it."""
    count = len(pre_tanh)
    padded = np.resize(np.asarray(pre_tanh), (-(-count // SIDE_BY_SIDE), SIDE_BY_SIDE, pre_tanh.shape[1]))
    parts = [_respond(plant, jnp.asarray(part), cycles, key) for part in padded]
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

    Raises PlantError where the plant itself fails, RunError where the memory does not suffice.
    """
    strokes = pre_tanh_of(np.array([[(0.475, 1), (-0.475, 1)] * 3], np.float32))
    # Raises where the plant does not go forward.
    argument = jit_argument(plant)
    try:
        slope = gait_sensitivity(argument, strokes, CYCLES, jax.random.key(0)).slope[:, :2]
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
