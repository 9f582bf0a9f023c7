"""The LSTM: one step, a sequence, resets."""

import jax
import jax.numpy as jnp
import numpy as np

from softfin.training.lstm import LSTM, Memory, cleared, weights


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_a_step_is_that_of_hochreiter_and_schmidhuber() -> None:
    lstm = LSTM.create(jax.random.key(0), 3, 4)
    random = np.random.default_rng(0)
    x, h, c = random.normal(size=3), random.normal(size=4), random.normal(size=4)
    i, f, g, o = np.split(x @ np.asarray(lstm.kernel) + h @ np.asarray(lstm.recurrent) + np.asarray(lstm.bias), 4)
    cell = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
    memory = lstm.step(Memory(jnp.float32(h), jnp.float32(c)), jnp.float32(x))
    np.testing.assert_allclose(memory.cell, cell, atol=1e-5)
    np.testing.assert_allclose(memory.hidden, sigmoid(o) * np.tanh(cell), atol=1e-5)


def test_step_by_step_equals_the_sequence_with_its_resets() -> None:
    lstm = LSTM.create(jax.random.key(0), 3, 8)
    x = jax.random.normal(jax.random.key(1), (20, 3))
    fresh = jnp.zeros(20, bool).at[jnp.array([0, 7, 8, 15])].set(True)
    before = Memory(jnp.ones(8), jnp.ones(8))

    memory, outputs = before, []
    for step in range(20):
        memory = lstm.step(cleared(memory, fresh[step]), x[step])
        outputs.append(memory.hidden)

    np.testing.assert_allclose(lstm.sequence(before, x, fresh), jnp.stack(outputs), atol=1e-6)


def test_nothing_before_a_reset_reaches_what_comes_after() -> None:
    lstm = LSTM.create(jax.random.key(0), 3, 8)
    fresh = jnp.zeros(10, bool).at[5].set(True)

    def after(x: jax.Array, start: Memory) -> jax.Array:
        return lstm.sequence(start, x, fresh)[5:].sum()

    slope, start = jax.grad(after, argnums=(0, 1))(jax.random.normal(jax.random.key(1), (10, 3)), lstm.init())
    assert not np.any(slope[:5])
    assert not np.any(start.hidden)
    assert np.any(slope[5:])


def test_new_weights_keep_the_variance_of_their_inputs() -> None:
    x = jax.random.normal(jax.random.key(0), (4000, 50))
    for gain in (1.0, 3.0):
        y = x @ weights(jax.random.key(1), (50, 200), gain)
        assert abs(float(y.std()) / gain - 1) < 0.05
