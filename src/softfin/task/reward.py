"""The reward (paper Sec. III-C2): mean force over the evaluation window against its reference, and smoothness.

A window holds the last `n` samples, the newest last. Of these only the last `count` were made since the reset, and
only they count.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from softfin.core.sobolev import Count, Forces, PerAxis, sobolev_mean, sobolev_sum

Smoothness: TypeAlias = Callable[[Forces, Count], PerAxis]


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
