"""What drive, water and sensor share: numbers as arrays, relaxation within a sample, rounding to a resolution."""

from collections.abc import Collection, Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S

SHORTEST_S = 1e-6
"""Shortest time constant [s] in computations; it keeps derivatives finite where one is zero."""


def arrays_of(config: Configuration, without: Collection[str] = ()) -> Iterator[Float[Array, ""]]:
    """Yield the numbers of a configuration as arrays, in the order of its fields."""
    return (jnp.asarray(value, float) for name, value in config.model_dump().items() if name not in without)


def remaining(time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """Return the fraction of a deviation that is left after a sample of 10 ms; 0 where the time constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, SHORTEST_S))


def to_multiple(value: Float[Array, "*shape"], step: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Return the nearest multiple of `step`, or `value` itself where the step is 0; its derivative is 1 either way."""
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)
