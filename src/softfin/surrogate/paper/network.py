"""Networks over a window of samples, described by their configuration: channels are the steps, the window the features.

This is the layout of the published weights (paper Sec. III-B): a window (channels, samples) goes into the first layer
as a sequence of `channels` steps with `samples` features each. Every layer works on a whole batch with as few and as
large matrix products as the mathematics allows.
"""

from collections.abc import Callable
from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError

Activation = Literal["linear", "relu", "tanh"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"linear": lambda x: x, "relu": jax.nn.relu, "tanh": jnp.tanh}

Parameters = dict[str, Array]
Shape = tuple[int, ...]
"""Of one example between layers: (steps, features) or (features,)."""


class Conv1D(Configuration):
    """Convolution over the steps, stride 1, zero-padded to the same length."""

    kind: Literal["conv1d"] = "conv1d"
    filters: PositiveInt
    kernel: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Of the parameters."""
        return {"kernel": (self.kernel, example[1], self.filters), "bias": (self.filters,)}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return (example[0], self.filters)

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

    def products(self, example: Shape) -> int:
        """Multiply-adds of the matrix products for one example, as `apply` does them."""
        return example[0] ** 2 * example[1] * self.filters


class LSTM(Configuration):
    """Long short-term memory (Hochreiter and Schmidhuber 1997); gates in the order input, forget, cell, output."""

    kind: Literal["lstm"] = "lstm"
    units: PositiveInt
    sequence: bool = False
    """Whether the hidden states of all steps go on, or only the last."""

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Of the parameters."""
        gates = 4 * self.units
        return {"kernel": (example[1], gates), "recurrent": (self.units, gates), "bias": (gates,)}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return (example[0], self.units) if self.sequence else (self.units,)

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """One product a step, of input and past side by side; the first step has no past, so nothing to forget."""
        hidden: Array | None = None
        cell: Array = jnp.float32(0)
        outputs = []
        kernel, bias = parameters["kernel"], parameters["bias"]
        both = jnp.concatenate([kernel, parameters["recurrent"]])
        for step in range(x.shape[1]):
            if hidden is None:
                i, g, o = jnp.split(x[:, step] @ self._without_forget(kernel) + self._without_forget(bias), 3, axis=-1)
                cell = jax.nn.sigmoid(i) * jnp.tanh(g)
            else:
                gates = jnp.concatenate([x[:, step], hidden], axis=1) @ both + bias
                i, f, g, o = jnp.split(gates, 4, axis=-1)
                cell = jax.nn.sigmoid(f) * cell + jax.nn.sigmoid(i) * jnp.tanh(g)
            hidden = jax.nn.sigmoid(o) * jnp.tanh(cell)
            outputs.append(hidden)
        return jnp.stack(outputs, axis=1) if self.sequence else outputs[-1]

    def products(self, example: Shape) -> int:
        """Multiply-adds of the matrix products for one example, as `apply` does them."""
        steps, features = example
        return self.units * (3 * features + 4 * (steps - 1) * (features + self.units))

    def _without_forget(self, gates: Array) -> Array:
        return jnp.concatenate([gates[..., : self.units], gates[..., 2 * self.units :]], axis=-1)


class MeanPool(Configuration):
    """Mean over the steps."""

    kind: Literal["mean_pool"] = "mean_pool"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """It has no parameters."""
        return {}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return example[1:]

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """(batch, features)."""
        return x.mean(axis=1)

    def products(self, example: Shape) -> int:
        """None."""
        return 0


class Flatten(Configuration):
    """Steps and features side by side."""

    kind: Literal["flatten"] = "flatten"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """It has no parameters."""
        return {}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return (int(np.prod(example)),)

    def apply(self, parameters: Parameters, x: Float[Array, "batch ..."]) -> Array:
        """(batch, steps * features)."""
        return x.reshape(x.shape[0], -1)

    def products(self, example: Shape) -> int:
        """None."""
        return 0


class Dense(Configuration):
    """A fully connected layer."""

    kind: Literal["dense"] = "dense"
    units: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """Of the parameters."""
        return {"kernel": (example[-1], self.units), "bias": (self.units,)}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return (*example[:-1], self.units)

    def apply(self, parameters: Parameters, x: Float[Array, "batch ... features"]) -> Array:
        """(batch, ..., units)."""
        return ACTIVATIONS[self.activation](x @ parameters["kernel"] + parameters["bias"])

    def products(self, example: Shape) -> int:
        """Multiply-adds of the matrix product for one example."""
        return int(np.prod(example)) * self.units


class Dropout(Configuration):
    """Drops features at random while training (Srivastava et al. 2014); does nothing afterwards."""

    kind: Literal["dropout"] = "dropout"
    rate: float = Field(ge=0, lt=1)

    def shapes(self, example: Shape) -> dict[str, Shape]:
        """It has no parameters."""
        return {}

    def output(self, example: Shape) -> Shape:
        """Shape of one example behind this layer."""
        return example

    def apply(self, parameters: Parameters, x: Array) -> Array:
        """Unchanged: see `Network.__call__` for training."""
        return x

    def products(self, example: Shape) -> int:
        """None."""
        return 0


Layer = Annotated[Conv1D | LSTM | MeanPool | Flatten | Dense | Dropout, Field(discriminator="kind")]


class NetworkConfig(Configuration):
    """What a network sees, what it says, and its layers."""

    channels: tuple[str, ...]
    """Names of the input channels, in the order in which they are the steps."""
    outputs: tuple[str, ...]
    """Names of the output channels."""
    window: PositiveInt = 100
    """Samples of the past that it sees [samples at 100 Hz]; the paper's 1 s."""
    layers: tuple[Layer, ...]

    def examples(self) -> list[Shape]:
        """Shape of one example before each layer and behind the last."""
        shapes: list[Shape] = [(len(self.channels), self.window)]
        for layer in self.layers:
            shapes.append(layer.output(shapes[-1]))
        return shapes

    def shapes(self) -> list[dict[str, Shape]]:
        """Of each layer's parameters."""
        return [layer.shapes(example) for layer, example in zip(self.layers, self.examples(), strict=False)]

    def parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(int(np.prod(shape)) for layer in self.shapes() for shape in layer.values())

    def flops(self) -> int:
        """Floating-point operations of the matrix products for one window, two a multiply-add."""
        return 2 * sum(layer.products(x) for layer, x in zip(self.layers, self.examples(), strict=False))


class Network(eqx.Module):
    """A network with its weights."""

    config: NetworkConfig = eqx.field(static=True)
    layers: tuple[Parameters, ...]

    def __call__(
        self, windows: Float[Array, "batch channels window"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch outputs"]:
        """Scaled windows to scaled outputs; a key means training, so dropout drops."""
        x = windows
        for index, (layer, parameters) in enumerate(zip(self.config.layers, self.layers, strict=True)):
            if isinstance(layer, Dropout) and key is not None:
                keep = jax.random.bernoulli(jax.random.fold_in(key, index), 1 - layer.rate, x.shape)
                x = jnp.where(keep, x / (1 - layer.rate), 0)
            else:
                x = layer.apply(parameters, x)
        return x

    def arrays(self) -> dict[str, np.ndarray]:
        """The weights by name: ``3.kernel`` is the kernel of the fourth layer."""
        return {f"{i}.{name}": np.asarray(a) for i, layer in enumerate(self.layers) for name, a in layer.items()}

    @classmethod
    def create(cls, config: NetworkConfig, key: PRNGKeyArray) -> "Network":
        """With fresh weights: Glorot-uniform, recurrent ones orthogonal, forget gates open (Keras's defaults)."""
        glorot, orthogonal = jax.nn.initializers.glorot_uniform(), jax.nn.initializers.orthogonal()
        layers = []
        for index, (layer, shapes) in enumerate(zip(config.layers, config.shapes(), strict=True)):
            parameters: Parameters = {}
            for name, shape in shapes.items():
                fresh = jax.random.fold_in(jax.random.fold_in(key, index), len(parameters))
                if name == "bias":
                    parameters[name] = jnp.zeros(shape)
                else:
                    parameters[name] = (orthogonal if name == "recurrent" else glorot)(fresh, shape)
            if isinstance(layer, LSTM):
                parameters["bias"] = parameters["bias"].at[layer.units : 2 * layer.units].set(1.0)
            layers.append(parameters)
        return cls(config, tuple(layers))

    @classmethod
    def of(cls, config: NetworkConfig, arrays: dict[str, np.ndarray], source: str) -> "Network":
        """From named weights; raises ArtifactError where one is missing, odd or of another shape."""
        expected = {f"{i}.{name}": shape for i, layer in enumerate(config.shapes()) for name, shape in layer.items()}
        for name in sorted(set(expected) ^ set(arrays)):
            what = "is missing" if name in expected else "is not in the configuration"
            raise ArtifactError(f"{source}: weight {name} {what}; copy the whole folder again")
        for name, shape in expected.items():
            if arrays[name].shape != shape:
                raise ArtifactError(f"{source}: weight {name} has shape {arrays[name].shape}; it must be {shape}")
            if not np.isfinite(arrays[name]).all():
                raise ArtifactError(f"{source}: weight {name} is not finite; train again")
        layers: list[Parameters] = [{} for _ in config.layers]
        for name in expected:
            index, _, leaf = name.partition(".")
            layers[int(index)][leaf] = jnp.asarray(arrays[name], jnp.float32)
        return cls(config, tuple(layers))
