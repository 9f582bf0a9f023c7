"""The recurrent core: inputs, outputs and memory split by what a mirror does to them.

A fin that is mirrored in the plane y = 0 is the same fin: angle, angular velocity and force y change sign (odd), force
x and speeds do not (even). `MirrorCore` has that built in, weight by weight. It is a gated recurrent unit:
h' = h + u (c - h) with a gate u and a candidate c.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

SLOWEST = 60.0
"""Gates begin with time constants from 2 to this many ticks, so that both ripples and strokes are remembered."""


class Parity(NamedTuple):
    """Sizes, inputs, outputs or memory, split by what a mirror does to them."""

    even: Any
    """Part that a mirror does not change."""
    odd: Any
    """Part whose sign a mirror changes."""


class MirrorCore(eqx.Module):
    """Mirrored inputs give mirrored outputs, exactly.

    Odd candidates are odd functions of odd inputs; gates, even candidates and what multiplies the odd ones are
    functions of even inputs and of `magnitude` of mixtures of the odd ones.
    """

    odd_in: Float[Array, "odd_inputs candidates_and_magnitudes"]
    even_in: Float[Array, "even_inputs gates_candidates_factors"]
    bias: Float[Array, "gates_candidates_factors"]
    hidden_in: Float[Array, "hidden_inputs hidden"]
    hidden_bias: Float[Array, "hidden"]
    even_out: Float[Array, "hidden even_outputs"]
    odd_out: Float[Array, "units odd_outputs"]
    odd_factors: Float[Array, "hidden odd_outputs_times_units"]
    units: int = eqx.field(static=True)

    def __init__(self, inputs: Parity, outputs: Parity, units: int, hidden: int, key: PRNGKeyArray) -> None:
        keys = jax.random.split(key, 4)
        self.units = units
        self.odd_in = _uniform(keys[0], units + inputs.odd, 2 * units)
        self.even_in = _uniform(keys[1], 2 * units + inputs.even, 4 * units)
        self.bias = jnp.concatenate([_gates(keys[2], 2 * units), jnp.zeros(units), jnp.ones(units)])
        self.hidden_in = _uniform(keys[3], 2 * units, hidden)
        self.hidden_bias = jnp.zeros(hidden)
        # Zero, so that training begins at the physics that stands beside the net.
        self.even_out = jnp.zeros((hidden, outputs.even))
        self.odd_out = jnp.zeros((units, outputs.odd))
        self.odd_factors = jnp.zeros((hidden, outputs.odd * units))

    def blank(self) -> Parity:
        """Memory that holds nothing yet."""
        return Parity(jnp.zeros(self.units), jnp.zeros(self.units))

    def step(self, memory: Parity, inputs: Parity) -> tuple[Parity, Parity]:
        """Step by one tick: (memory, inputs) -> (memory, outputs)."""
        n = self.units
        candidates, mixtures = jnp.split(jnp.concatenate([memory.odd, inputs.odd]) @ self.odd_in, 2)
        sizes = magnitude(mixtures)
        gates = jnp.concatenate([memory.even, inputs.even, sizes]) @ self.even_in + self.bias
        opening = jax.nn.sigmoid(gates[: 2 * n])
        even = memory.even + opening[:n] * (jnp.tanh(gates[2 * n : 3 * n]) - memory.even)
        odd = memory.odd + opening[n:] * (jnp.tanh(candidates * gates[3 * n :]) - memory.odd)
        hidden = jnp.tanh(jnp.concatenate([even, sizes]) @ self.hidden_in + self.hidden_bias)
        factors = self.odd_out.T + (hidden @ self.odd_factors).reshape(-1, n)
        return Parity(even, odd), Parity(hidden @ self.even_out, factors @ odd)


def products(net: eqx.Module) -> int:
    """Multiplications of the matrix products of one tick: every matrix of one fin's nets is used once."""
    return sum(leaf.size for leaf in jax.tree.leaves(net) if leaf.ndim == 2)


def magnitude(x: Array) -> Array:
    """Return sqrt(1 + x^2) - 1: even and smooth, x^2 / 2 where small and |x| where large, as drag in the velocity."""
    return jnp.sqrt(1 + x * x) - 1


def _uniform(key: PRNGKeyArray, inputs: int, outputs: int) -> Float[Array, "inputs outputs"]:
    """Draw entries of variance 1/2 over the inputs: less than keeps the spread, since all memory is fed back."""
    reach = jnp.sqrt(1.5 / inputs)
    return jax.random.uniform(key, (inputs, outputs), minval=-reach, maxval=reach)


def _gates(key: PRNGKeyArray, units: int) -> Float[Array, "units"]:
    """Draw biases that open the gates by 1 / time constant, from 1/2 to 1/`SLOWEST` a tick, in random order."""
    return jax.random.permutation(key, -jnp.log(jnp.geomspace(2.0, SLOWEST, units) - 1))
