"""The layers of the paper's nets, each working on a whole batch with as few and as large matrix products as it can.

They are not Equinox's: those work example by example, with a product for input and past each, and take longer.
"""

from collections.abc import Callable
from math import prod
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration

Activation = Literal["linear", "relu", "tanh"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"linear": lambda x: x, "relu": jax.nn.relu, "tanh": jnp.tanh}

Parameters = dict[str, Array]
Shape = tuple[int, ...]
"""Shape of one example between layers: (steps, features) or (features,)."""


class BaseLayer(Configuration):
    """A layer; here one that has no parameters and changes nothing."""

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Shapes of the parameters by name."""
        return {}

    def apply(self, parameters: Parameters, x: Float[Array, "batch *example"]) -> Array:
        """Output of the layer for a batch of examples."""
        return x

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        shape: Shape = jax.eval_shape(self.apply, *self._abstract(example)).shape
        return shape[1:]

    def products(self, example: Shape) -> int:
        """Multiply-adds of the matrix products for one example, as `apply` does them."""
        steps = jax.make_jaxpr(self.apply)(*self._abstract(example)).eqns
        return sum(
            step.outvars[0].aval.size * prod(step.invars[0].aval.shape[axis] for axis in contracted)
            for step in steps
            if step.primitive.name == "dot_general"
            for (contracted, _), _ in [step.params["dimension_numbers"]]
        )

    def _abstract(self, example: Shape) -> tuple[dict[str, jax.ShapeDtypeStruct], jax.ShapeDtypeStruct]:
        shapes = {"": (1, *example), **self.shapes(example)}
        abstract = {name: jax.eval_shape(lambda shape=shape: jnp.zeros(shape)) for name, shape in shapes.items()}
        return abstract, abstract.pop("")


class Conv1D(BaseLayer):
    """Convolution over the steps, stride 1, zero-padded to the same length."""

    kind: Literal["conv1d"] = "conv1d"
    filters: PositiveInt
    kernel: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Kernel (taps, features, filters) and bias."""
        return {"kernel": (self.kernel, example[1], self.filters), "bias": (self.filters,)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """One matrix product: with few steps nearly every block of the convolution's matrix is used."""
        batch, steps, features = x.shape
        kernel = parameters["kernel"]
        left = (self.kernel - 1) // 2
        empty = jnp.zeros((features, self.filters), kernel.dtype)

        def block(source: int, target: int) -> Array:
            tap = source - target + left
            return kernel[tap] if 0 <= tap < self.kernel else empty

        matrix = jnp.block([[block(source, target) for target in range(steps)] for source in range(steps)])
        y = (x.reshape(batch, steps * features) @ matrix).reshape(batch, steps, self.filters)
        return ACTIVATIONS[self.activation](y + parameters["bias"])


class LSTM(BaseLayer):
    """Long short-term memory (Hochreiter and Schmidhuber 1997); gates in the order input, forget, cell, output."""

    kind: Literal["lstm"] = "lstm"
    units: PositiveInt
    sequence: bool = False
    """Whether the hidden states of all steps go on, or only the last."""

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Kernel (features, gates), recurrent kernel (units, gates) and bias."""
        gates = 4 * self.units
        return {"kernel": (example[1], gates), "recurrent": (self.units, gates), "bias": (gates,)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """One product a step, of input and past side by side; the first step has no past, so nothing to forget."""
        kernel, bias = parameters["kernel"], parameters["bias"]
        both = jnp.concatenate([kernel, parameters["recurrent"]])
        i, g, o = jnp.split(x[:, 0] @ self._without_forget(kernel) + self._without_forget(bias), 3, axis=-1)
        cell = jax.nn.sigmoid(i) * jnp.tanh(g)
        outputs = [jax.nn.sigmoid(o) * jnp.tanh(cell)]
        for step in range(1, x.shape[1]):
            gates = jnp.concatenate([x[:, step], outputs[-1]], axis=1) @ both + bias
            i, f, g, o = jnp.split(gates, 4, axis=-1)
            cell = jax.nn.sigmoid(f) * cell + jax.nn.sigmoid(i) * jnp.tanh(g)
            outputs.append(jax.nn.sigmoid(o) * jnp.tanh(cell))
        return jnp.stack(outputs, axis=1) if self.sequence else outputs[-1]

    def _without_forget(self, gates: Array) -> Array:
        return jnp.concatenate([gates[..., : self.units], gates[..., 2 * self.units :]], axis=-1)


class MeanPool(BaseLayer):
    """Mean over the steps."""

    kind: Literal["mean_pool"] = "mean_pool"

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """(batch, features)."""
        return x.mean(axis=1)


class Flatten(BaseLayer):
    """Steps and features side by side."""

    kind: Literal["flatten"] = "flatten"

    def apply(self, parameters: Parameters, x: Float[Array, "batch ..."]) -> Array:
        """(batch, steps * features)."""
        return x.reshape(x.shape[0], -1)


class Dense(BaseLayer):
    """A fully connected layer."""

    kind: Literal["dense"] = "dense"
    units: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Kernel (features, units) and bias."""
        return {"kernel": (example[-1], self.units), "bias": (self.units,)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch ... features"]) -> Array:
        """(batch, ..., units)."""
        return ACTIVATIONS[self.activation](x @ parameters["kernel"] + parameters["bias"])


class Dropout(BaseLayer):
    """Drops features at random in training (Srivastava et al. 2014), see `Network.__call__`; else changes nothing."""

    kind: Literal["dropout"] = "dropout"
    rate: float = Field(ge=0, lt=1)


Layer = Annotated[Conv1D | LSTM | MeanPool | Flatten | Dense | Dropout, Field(discriminator="kind")]
