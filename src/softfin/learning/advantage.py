"""Generalised advantage estimation (Schulman et al. 2016) over environments that are cut, never ended."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

PerStep = Float[Array, "time environments"]


def advantages(
    reward: PerStep,
    value: PerStep,
    value_after: PerStep,
    cut: Bool[Array, "time environments"],
    discount: float,
    trace: float,
) -> PerStep:
    """A_t = d_t + discount trace A_{t+1},  d_t = r_t + discount V'_t - V_t.

    V' is the value of the state that the action led to, before any reset: the fin could have beaten on, so a cut is
    bootstrapped with it, and only the sum stops there.
    """
    errors = reward + discount * value_after - value

    def back(advantage: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        error, is_cut = now
        advantage = error + discount * trace * jnp.where(is_cut, 0.0, advantage)
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(errors[0]), (errors, cut), reverse=True)[1]
