"""Quantisation that gradients pass through: what encoder and force sensor do to their readings."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def to_multiple(value: Float[Array, "*shape"], step: Float[Array, ""]) -> Float[Array, "*shape"]:
    """The nearest multiple of `step`, or `value` itself where the step is 0; its derivative is 1 either way."""
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)
