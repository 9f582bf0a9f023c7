"""An LSTM cell that can be stepped, and run over a whole sequence with its memory cleared at resets."""

from typing import Any, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray


class Memory(NamedTuple):
    """Memory of an LSTM."""

    hidden: Float[Array, "*batch units"]
    cell: Float[Array, "*batch units"]


Memories = TypeVar("Memories", bound=tuple[Any, ...])


class LSTM(eqx.Module):
    """Hochreiter and Schmidhuber 1997 with forget gates; gates in the order input, forget, cell, output."""

    kernel: Float[Array, "inputs gates"]
    recurrent: Float[Array, "units gates"]
    bias: Float[Array, "gates"]

    @classmethod
    def create(cls, key: PRNGKeyArray, inputs: int, units: int) -> "LSTM":
        """New weights; the forget gate starts open, so that early gradients reach far back."""
        kernel, recurrent = (
            weights(k, shape)
            for k, shape in zip(jax.random.split(key), ((inputs, 4 * units), (units, 4 * units)), strict=True)
        )
        return cls(kernel, recurrent, jnp.zeros(4 * units).at[units : 2 * units].set(1.0))

    def init(self) -> Memory:
        """Empty memory."""
        empty = jnp.zeros(self.recurrent.shape[0])
        return Memory(empty, empty)

    def step(self, memory: Memory, x: Float[Array, "inputs"]) -> Memory:
        """One step; its output is the new hidden state."""
        return self._step(memory, self._project(x))

    def sequence(
        self, memory: Memory, x: Float[Array, "time inputs"], is_first: Bool[Array, "time"]
    ) -> Float[Array, "time units"]:
        """The hidden state after each step, the memory cleared before every step that `is_first`."""

        def step(memory: Memory, now: tuple[Array, Array]) -> tuple[Memory, Array]:
            gates, first = now
            memory = self._step(cleared(memory, first), gates)
            return memory, memory.hidden

        return jax.lax.scan(step, memory, (self._project(x), is_first))[1]

    def _project(self, x: Float[Array, "*time inputs"]) -> Float[Array, "*time gates"]:
        return x @ self.kernel + self.bias

    def _step(self, memory: Memory, gates: Float[Array, "gates"]) -> Memory:
        i, f, g, o = jnp.split(gates + memory.hidden @ self.recurrent, 4)
        cell = jax.nn.sigmoid(f) * memory.cell + jax.nn.sigmoid(i) * jnp.tanh(g)
        return Memory(jax.nn.sigmoid(o) * jnp.tanh(cell), cell)


def weights(key: PRNGKeyArray, shape: tuple[int, int], gain: float = 1.0) -> Float[Array, "inputs outputs"]:
    """Uniform random weights that keep the variance of their inputs, times gain^2."""
    bound = gain * (3 / shape[0]) ** 0.5
    return jax.random.uniform(key, shape, minval=-bound, maxval=bound)


def cleared(memory: Memories, where: Bool[Array, ""]) -> Memories:
    """The memory of one LSTM or of several, emptied where true."""
    return cast(Memories, jax.tree.map(lambda x: jnp.where(where, 0.0, x), memory))
