"""The reward (paper Sec. III-C2): mean force over the evaluation window against its reference, and smoothness.

A window holds the last `n` samples, the newest last. Of these only the last `count` were recorded since the reset, and
only they count. Another term is another field of `RewardTerms`, with its weight in `RewardConfig.value`.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import NonNegativeFloat

from softfin.core.configuration import Configuration


class RewardTerms(NamedTuple):
    """What the reward weighs, for each axis [N]."""

    error: Float[Array, "*batch 2"]
    """|F_e|: distance of the window's mean force from its target."""
    smoothness: Float[Array, "*batch 2"]
    """Sobolev term of the window."""


class RewardConfig(Configuration):
    """Weights of the reward; the paper names them and gives no values."""

    weight: tuple[NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0)
    """Weight w of x and y."""
    smoothness: tuple[NonNegativeFloat, NonNegativeFloat] = (0.01, 0.01)
    """Weight lambda of x and y; for a full window 0.01 in the form `sum` weighs as much as 0.14 in the form `mean`."""
    sobolev: Literal["sum", "mean"] = "sum"
    """Form of the Sobolev term: the paper's sum of squared steps or the published code's mean."""
    target: Literal["now", "window"] = "now"
    """Target of the window's mean force: the reference of this moment, as in the paper, or the mean of the references
    over the window, which does not reward making up for earlier ones."""

    def value(self, terms: RewardTerms) -> Float[Array, "*batch"]:
        """The reward r = -sum_d w_d (|F_e^d| + lambda_d S_d) [N]."""
        weight, smoothness = jnp.asarray(self.weight), jnp.asarray(self.smoothness)
        return -jnp.sum(weight * (terms.error + smoothness * terms.smoothness), axis=-1)
