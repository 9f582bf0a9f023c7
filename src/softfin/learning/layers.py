"""Layers of the policy and the critic: linear layer, LSTM cell and running normalization."""

from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from softfin.control.policy import MIN_DEVIATION, PolicyMemory

Memories = TypeVar("Memories", bound=tuple[Any, ...])


NumberBatch = Float[Array, "*batch numbers"]


class LinearLayer(eqx.Module):
    """A linear layer, x W + b."""

    kernel: Float[Array, "inputs outputs"]
    bias: Float[Array, "outputs"]

    @classmethod
    def create(cls, key: PRNGKeyArray, inputs: int, outputs: int, gain: float) -> "LinearLayer":
        """Initialize a layer; `gain` scales its outputs."""
        return cls(weights(key, (inputs, outputs), gain), jnp.zeros(outputs))

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Return the outputs for each vector in a batch."""
        return x @ self.kernel + self.bias


class LSTMCell(eqx.Module):
    """LSTM cell (Hochreiter and Schmidhuber 1997) with forget gates. The order of the gates is
    input, forget, cell, output."""

    kernel: Float[Array, "inputs gates"]
    recurrent: Float[Array, "units gates"]
    bias: Float[Array, "gates"]

    @classmethod
    def create(cls, key: PRNGKeyArray, inputs: int, units: int) -> "LSTMCell":
        """Initialize a cell with an open forget gate so that gradients initially reach far back in
        time."""
        first, second = jax.random.split(key)
        kernel = weights(first, (inputs, 4 * units))
        recurrent = weights(second, (units, 4 * units))
        return cls(kernel, recurrent, jnp.zeros(4 * units).at[units : 2 * units].set(1.0))

    def init(self) -> PolicyMemory:
        """Return an empty memory."""
        empty = jnp.zeros(self.recurrent.shape[0])
        return PolicyMemory(empty, empty)

    def step(self, memory: PolicyMemory, x: Float[Array, "inputs"]) -> PolicyMemory:
        """Advance by one step; the output is the hidden state of the new memory."""
        return self._step(memory, x @ self.kernel + self.bias)

    def sequence(
        self, memory: PolicyMemory, x: Float[Array, "time inputs"], is_first: Bool[Array, "time"]
    ) -> Float[Array, "time units"]:
        """Return the hidden state after each step. The memory is cleared before each step with
        `is_first` set."""

        def step(memory: PolicyMemory, now: tuple[Array, Array]) -> tuple[PolicyMemory, Array]:
            gates, first = now
            memory = self._step(cleared(memory, first), gates)
            return memory, memory.hidden

        # The product with the inputs does not depend on the memory, so it is computed as one large
        # product.
        return jax.lax.scan(step, memory, (x @ self.kernel + self.bias, is_first))[1]

    def _step(self, memory: PolicyMemory, gates: Float[Array, "gates"]) -> PolicyMemory:
        # c' = sigmoid(f) c + sigmoid(i) tanh(g), h' = sigmoid(o) tanh(c')
        i, f, g, o = jnp.split(gates + memory.hidden @ self.recurrent, 4)
        cell = jax.nn.sigmoid(f) * memory.cell + jax.nn.sigmoid(i) * jnp.tanh(g)
        return PolicyMemory(jax.nn.sigmoid(o) * jnp.tanh(cell), cell)


def weights(
    key: PRNGKeyArray, shape: tuple[int, int], gain: float = 1.0
) -> Float[Array, "inputs outputs"]:
    """Return uniform random weights; the variance of the outputs is the variance of the inputs
    times gain^2."""
    # A uniform distribution on [-b, b] has variance b^2 / 3.
    bound = gain * (3 / shape[0]) ** 0.5
    return jax.random.uniform(key, shape, minval=-bound, maxval=bound)


def cleared(memory: Memories, where: Bool[Array, ""]) -> Memories:
    """Return the memory of one or several LSTMs, set to 0 if `where` is true."""
    return cast(Memories, jax.tree.map(lambda x: jnp.where(where, 0.0, x), memory))


class Normalisation(eqx.Module):
    """Normalizes vectors element by element, (x - mean) / std. Before the first call of `updated`,
    it is the identity.

    The statistics are leaves of the network and are saved with the weights, but they have no
    gradient.
    """

    mean: Float[Array, "*stack numbers"]
    std: Float[Array, "*stack numbers"]
    """Standard deviation; the divisor is at least `MIN_DEVIATION`."""
    count: Float[Array, "*stack"]
    """Number of vectors in the statistics."""

    @classmethod
    def create(cls, numbers: int) -> "Normalisation":
        """Return the identity."""
        return cls(jnp.zeros(numbers), jnp.ones(numbers), jnp.zeros(()))

    def __call__(self, x: NumberBatch) -> NumberBatch:
        """Return the normalized vectors."""
        return (x - jax.lax.stop_gradient(self.mean)) / jax.lax.stop_gradient(self.scale)

    def inverse(self, x: NumberBatch) -> NumberBatch:
        """Return the vectors before normalization."""
        return jax.lax.stop_gradient(self.mean) + jax.lax.stop_gradient(self.scale) * x

    def updated(self, x: NumberBatch, most: float | int = jnp.inf) -> "Normalisation":
        """Return the normalization updated by a batch of vectors.

        All earlier vectors together have a weight of at most `most` vectors. Means and variances
        are merged as in Chan, Golub and LeVeque 1979.
        """
        # With n = old + new vectors and d = mean_new - mean_old:
        # mean = mean_old + d new / n
        # variance = (old var_old + new var_new) / n + old new (d / n)^2
        rows = x.reshape(-1, x.shape[-1])
        new = float(len(rows))
        old = jnp.minimum(self.count, most)
        total = old + new
        step = rows.mean(axis=0) - self.mean
        variance = (old * self.std**2 + new * rows.var(axis=0)) / total + old * new * (
            step / total
        ) ** 2
        return Normalisation(self.mean + step * new / total, jnp.sqrt(variance), total)

    @property
    def scale(self) -> Float[Array, "*stack numbers"]:
        """Divisor of the deviations from the mean."""
        return jnp.maximum(self.std, MIN_DEVIATION)
