"""Generalised advantage estimation (Schulman et al. 2016) over environments that are cut, never ended."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

PerStep = Float[Array, "time environments"]


def advantages(
    reward: PerStep,
    value: PerStep,
    value_after: Float[Array, "environments"],
    cut: Bool[Array, "time environments"],
    value_beyond: PerStep,
    discount: float,
    trace: float,
) -> PerStep:
    """A_t = d_t + discount trace A_{t+1},  d_t = r_t + discount V_{t+1} - V_t.

    At a cut the sum stops, and V_{t+1} is the value of the state that the episode was cut in (`value_beyond`), since
    the fin could have beaten on; behind the last step it is `value_after`.
    """
    following = jnp.concatenate([value[1:], value_after[None]])
    errors = reward + discount * jnp.where(cut, value_beyond, following) - value

    def back(advantage: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        error, is_cut = now
        advantage = error + discount * trace * jnp.where(is_cut, 0.0, advantage)
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(value_after), (errors, cut), reverse=True)[1]
