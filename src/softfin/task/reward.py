"""The reward (paper Sec. III-C2): mean force over the evaluation window against its reference, and smoothness.

A window holds the last `n` samples, the newest last. Of these only the last `count` were made since the reset, and
only they count.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Forces: TypeAlias = Float[Array, "n 2"]
Count: TypeAlias = Int[Array, ""]
PerAxis: TypeAlias = Float[Array, "2"]
Smoothness: TypeAlias = Callable[[Forces, Count], PerAxis]


def sobolev_sum(forces: Forces, count: Count) -> PerAxis:
    """The paper's form, sqrt(sum_i |F_{i+1} - F_i|^2) [N]: it grows with the root of the window's length."""
    return _root(_squared_steps(forces, count))


def sobolev_mean(forces: Forces, count: Count) -> PerAxis:
    """The published code's form, sqrt(mean_i |F_{i+1} - F_i|^2) [N]: it does not depend on the window's length."""
    return _root(_squared_steps(forces, count) / jnp.maximum(count - 1, 1))


SMOOTHNESS: Mapping[str, Smoothness] = MappingProxyType({"sum": sobolev_sum, "mean": sobolev_mean})
"""The two forms of the Sobolev term by name."""


def reward(
    error: Float[Array, "*batch 2"],
    smoothness: Float[Array, "*batch 2"],
    disagreement: Float[Array, "*batch 2"],
    weight: PerAxis,
    smoothness_weight: PerAxis,
    disagreement_weight: float | int,
) -> Float[Array, "*batch"]:
    """r = -sum_d w_d (|F_e^d| + lambda_d S_d + mu D_d); the disagreement D of an ensemble is not the paper's."""
    return -jnp.sum(weight * (error + smoothness_weight * smoothness + disagreement_weight * disagreement), axis=-1)


def _squared_steps(forces: Forces, count: Count) -> PerAxis:
    """sum_i |F_{i+1} - F_i|^2 over the pairs of which both samples count."""
    counts = jnp.arange(len(forces) - 1) >= len(forces) - count
    return jnp.where(counts[:, None], jnp.diff(forces, axis=0) ** 2, 0).sum(axis=0)


def _root(square: PerAxis) -> PerAxis:
    """The square root with slope 0 at 0: a fin at rest makes no force, and sqrt's slope there is infinite."""
    moves = square > 0
    return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1)), 0)
