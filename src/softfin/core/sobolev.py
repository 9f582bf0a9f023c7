"""The Sobolev term of a window of forces: how much consecutive samples differ (paper Sec. III-C2).

A window holds `n` samples, the newest last. Only the last `count` of them were made since the reset and are counted.
"""

from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Forces: TypeAlias = Float[Array, "n 2"]
Count: TypeAlias = Int[Array, ""]
PerAxis: TypeAlias = Float[Array, "2"]


def sobolev_sum(forces: Forces, count: Count) -> PerAxis:
    """Compute the paper's form, sqrt(sum_i |F_{i+1} - F_i|^2) [N]: it grows with the root of the window's length."""
    return _root(_squared_steps(forces, count))


def sobolev_mean(forces: Forces, count: Count) -> PerAxis:
    """Compute the published code's form, sqrt(mean_i |F_{i+1} - F_i|^2) [N]: the window's length does not matter."""
    return _root(_squared_steps(forces, count) / jnp.maximum(count - 1, 1))


def _squared_steps(forces: Forces, count: Count) -> PerAxis:
    """Sum |F_{i+1} - F_i|^2 over the pairs of which both samples are counted."""
    counts = jnp.arange(len(forces) - 1) >= len(forces) - count
    return jnp.where(counts[:, None], jnp.diff(forces, axis=0) ** 2, 0).sum(axis=0)


def _root(square: PerAxis) -> PerAxis:
    """Take the square root, with slope 0 at 0: a fin at rest makes no force, and sqrt's slope there is infinite."""
    moves = square > 0
    return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1)), 0)
