"""What happens within one sample of 10 ms: first-order relaxation, and rounding to the resolution of a device."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S

SHORTEST_S = 1e-6
"""Shortest time constant [s] in computations; it keeps derivatives finite where one is zero."""


def remaining(time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """Return the fraction of a deviation that is left after a sample of 10 ms; 0 where the time constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, SHORTEST_S))


def to_multiple(value: Float[Array, "*shape"], step: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Return the nearest multiple of `step`, or `value` itself where the step is 0; its derivative is 1 either way."""
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)
