"""The LSTM: one step, a sequence, resets."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from softfin.control.policy import PolicyMemory
from softfin.learning.layers import LSTMCell, cleared, weights

create = jax.jit(LSTMCell.create, static_argnums=(1, 2))


@jax.jit
def step(lstm: LSTMCell, memory: PolicyMemory, x: Any, fresh: Any) -> PolicyMemory:
    return lstm.step(cleared(memory, fresh), x)


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_a_step_is_that_of_hochreiter_and_schmidhuber() -> None:
    lstm = create(jax.random.key(0), 3, 4)
    random = np.random.default_rng(0)
    x = random.normal(size=3)
    h = random.normal(size=4)
    c = random.normal(size=4)
    i, f, g, o = np.split(
        x @ np.asarray(lstm.kernel) + h @ np.asarray(lstm.recurrent) + np.asarray(lstm.bias), 4
    )
    cell = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
    memory = step(lstm, PolicyMemory(np.float32(h), np.float32(c)), np.float32(x), False)
    np.testing.assert_allclose(memory.cell, cell, atol=1e-5)
    np.testing.assert_allclose(memory.hidden, sigmoid(o) * np.tanh(cell), atol=1e-5)


def test_step_by_step_equals_the_sequence_with_its_resets() -> None:
    lstm = create(jax.random.key(0), 3, 8)
    x = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    fresh = np.isin(np.arange(20), [0, 7, 8, 15])
    before = PolicyMemory(np.ones(8, np.float32), np.ones(8, np.float32))

    memory = before
    outputs = []
    for now in zip(x, fresh, strict=True):
        memory = step(lstm, memory, *now)
        outputs.append(np.asarray(memory.hidden))

    np.testing.assert_allclose(
        jax.jit(LSTMCell.sequence)(lstm, before, x, fresh), np.stack(outputs), atol=1e-6
    )


def test_nothing_before_a_reset_reaches_what_comes_after() -> None:
    lstm = create(jax.random.key(0), 3, 8)
    fresh = jnp.asarray(np.arange(10) == 5)

    def after(x: jax.Array, start: PolicyMemory) -> jax.Array:
        return lstm.sequence(start, x, fresh)[5:].sum()

    x = np.random.default_rng(1).normal(size=(10, 3)).astype(np.float32)
    slopes = jax.jit(jax.grad(after, argnums=(0, 1)))(
        x, PolicyMemory(np.zeros(8, np.float32), np.zeros(8, np.float32))
    )
    slope, start = jax.tree.map(np.asarray, slopes)
    assert not np.any(slope[:5])
    assert not np.any(start.hidden)
    assert np.any(slope[5:])


def test_new_weights_keep_the_variance_of_their_inputs() -> None:
    x = np.random.default_rng(0).normal(size=(4000, 50))
    made = jax.jit(lambda: [weights(jax.random.key(1), (50, 200), gain) for gain in (1.0, 3.0)])()
    for gain, kernel in zip((1.0, 3.0), made, strict=True):
        y = x @ np.asarray(kernel)
        assert abs(float(y.std()) / gain - 1) < 0.05
