"""Advantages against a plain loop."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.learning.ppo import advantages


@settings(max_examples=10, deadline=None)
@given(discount=st.floats(0.1, 0.99), gae_lambda=st.floats(0, 1), seed=st.integers(0, 100))
def test_advantages_equal_a_plain_loop_with_truncations_bootstrapped(
    discount: float, gae_lambda: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    reward, value, after = random.normal(size=(3, 12, 2)).astype(np.float32)
    truncated = random.random((12, 2)) < 0.2

    expected = np.zeros((12, 2))
    for env in range(2):
        advantage = 0.0
        for t in reversed(range(12)):
            if truncated[t, env]:
                advantage = 0.0
            advantage = (
                reward[t, env]
                + discount * after[t, env]
                - value[t, env]
                + discount * gae_lambda * advantage
            )
            expected[t, env] = advantage

    got = advantages(
        *(jnp.asarray(x) for x in (reward, value, after, truncated)), discount, gae_lambda
    )
    np.testing.assert_allclose(got, expected, atol=1e-4)
