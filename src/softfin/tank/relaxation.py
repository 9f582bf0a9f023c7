"""First-order relaxation over one sample."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S

SHORTEST_S = 1e-6
"""Time constants below this count as none; it keeps derivatives finite where one is zero."""


def kept(time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """Share of a deviation that is left after a sample of 10 ms; 0 where the time constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, SHORTEST_S))
