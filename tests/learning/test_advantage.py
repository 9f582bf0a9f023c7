"""Advantages against a plain loop."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.learning.advantage import advantages


@settings(max_examples=10, deadline=None)
@given(discount=st.floats(0.1, 0.99), trace=st.floats(0, 1), seed=st.integers(0, 100))
def test_advantages_equal_a_plain_loop_with_cuts_bootstrapped(discount: float, trace: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    reward, value, after = random.normal(size=(3, 12, 2)).astype(np.float32)
    cut = random.random((12, 2)) < 0.2

    expected = np.zeros((12, 2))
    for env in range(2):
        advantage = 0.0
        for t in reversed(range(12)):
            if cut[t, env]:
                advantage = 0.0
            advantage = reward[t, env] + discount * after[t, env] - value[t, env] + discount * trace * advantage
            expected[t, env] = advantage

    got = advantages(*(jnp.asarray(x) for x in (reward, value, after, cut)), discount, trace)
    np.testing.assert_allclose(got, expected, atol=1e-4)
