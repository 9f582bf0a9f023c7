"""Networks over a window of samples, described by their configuration: the channels are the steps
of the sequence, the window its features.

This is the layout of the published weights (paper Sec. III-B): a window (channels, samples) goes
into the first layer as a sequence of `channels` steps with `samples` features each.
"""

from collections.abc import Callable
from math import prod
from typing import Annotated, Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES

MAX_CHUNK_WINDOWS = 2048
"""Number of windows that a network takes from a table at once: enough for efficient matrix
products, few enough for the caches."""

Activation = Literal["linear", "relu", "tanh"]
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "linear": lambda x: x,
    "relu": jax.nn.relu,
    "tanh": jnp.tanh,
}

Parameters = dict[str, Array]
Shapes = dict[str, jax.ShapeDtypeStruct]
Shape = tuple[int, ...]
"""Shape of one example between layers: (steps, features) or (features,)."""


def abstract(*shape: int) -> Any:
    """Stand-in for an array of this shape."""
    return cast(Any, jax.ShapeDtypeStruct)(shape, jnp.float32)


class BaseLayer(Configuration):
    """A layer that works on a whole batch with few, large products, faster than Equinox's. This
    base class passes its input through."""

    def shapes(self, example: Shape) -> Shapes:
        """Shapes of the parameters by name."""
        return {}

    def apply(self, parameters: Parameters, x: Float[Array, "batch *example"]) -> Array:
        """Output of the layer for a batch of examples."""
        return x


class Conv1D(BaseLayer):
    """Convolution over the steps, stride 1, zero-padded to the same length."""

    kind: Literal["conv1d"] = "conv1d"
    filters: PositiveInt
    kernel: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> Shapes:
        """Kernel (taps, features, filters) and bias."""
        return {
            "kernel": abstract(self.kernel, example[1], self.filters),
            "bias": abstract(self.filters),
        }

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """Compute the convolution as one matrix product: with few steps nearly every block of its
        matrix is used."""
        batch, steps, features = x.shape
        kernel = parameters["kernel"]
        # Keras's padding "same": an even kernel reaches one step further to the right.
        left = (self.kernel - 1) // 2
        empty = jnp.zeros((features, self.filters), kernel.dtype)

        def block(tap: int) -> Array:
            return kernel[tap] if 0 <= tap < self.kernel else empty

        # Blocks instead of an index: with one fin a step is an eighth faster.
        matrix = jnp.block(
            [[block(source - target + left) for target in range(steps)] for source in range(steps)]
        )
        y = (x.reshape(batch, steps * features) @ matrix).reshape(batch, steps, self.filters)
        return ACTIVATIONS[self.activation](y + parameters["bias"])


class LSTM(BaseLayer):
    """Long short-term memory (Hochreiter and Schmidhuber 1997); gates in the order input, forget,
    cell, output."""

    kind: Literal["lstm"] = "lstm"
    units: PositiveInt
    sequence: bool = False
    """Whether the layer returns the hidden states of all steps, or only the last."""

    def shapes(self, example: Shape) -> Shapes:
        """Kernel (features, gates), recurrent kernel (units, gates) and bias."""
        gates = 4 * self.units
        kernels = {"kernel": abstract(example[1], gates), "recurrent": abstract(self.units, gates)}
        return {**kernels, "bias": abstract(gates)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """Do one product per step, of input and hidden state together; the first step has no past,
        so nothing to forget."""
        kernel = parameters["kernel"]
        bias = parameters["bias"]
        both = jnp.concatenate([kernel, parameters["recurrent"]])
        # c' = sigmoid(f) c + sigmoid(i) tanh(g), h = sigmoid(o) tanh(c')
        i, g, o = jnp.split(
            x[:, 0] @ self._without_forget(kernel) + self._without_forget(bias), 3, axis=-1
        )
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
    """Flattens steps and features."""

    kind: Literal["flatten"] = "flatten"

    def apply(self, parameters: Parameters, x: Float[Array, "batch ..."]) -> Array:
        """(batch, steps * features)."""
        return x.reshape(x.shape[0], -1)


class Dense(BaseLayer):
    """A fully connected layer."""

    kind: Literal["dense"] = "dense"
    units: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> Shapes:
        """Kernel (features, units) and bias."""
        return {"kernel": abstract(example[-1], self.units), "bias": abstract(self.units)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch ... features"]) -> Array:
        """(batch, ..., units)."""
        return ACTIVATIONS[self.activation](x @ parameters["kernel"] + parameters["bias"])


class Dropout(BaseLayer):
    """Drops features at random in training (Srivastava et al. 2014), see `Network.__call__`;
    otherwise passes its input through."""

    kind: Literal["dropout"] = "dropout"
    rate: float = Field(ge=0, lt=1)


Layer = Annotated[Conv1D | LSTM | MeanPool | Flatten | Dense | Dropout, Field(discriminator="kind")]


class NetworkConfig(Configuration):
    """Channels of a network and its layers."""

    channels: tuple[str, ...]
    """Names of the input channels, in the order in which they are the steps."""
    outputs: tuple[str, ...]
    """Names of the output channels."""
    window: PositiveInt = 100
    """Number of past samples that it sees [samples at 100 Hz]; the paper's 1 s."""
    layers: tuple[Layer, ...]

    def shapes(self) -> tuple[Shapes, ...]:
        """Shapes of each layer's parameters."""
        example: Shape = (len(self.channels), self.window)
        shapes = []
        for layer in self.layers:
            shapes.append(layer.shapes(example))
            # Each layer's output is the next one's input.
            output = jax.eval_shape(layer.apply, shapes[-1], abstract(1, *example))
            example = output.shape[1:]
        return tuple(shapes)

    def parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(shape.size for layer in self.shapes() for shape in layer.values())

    def flops(self) -> int:
        """Floating-point operations of the matrix products for one window, two per multiply-add."""
        program = jax.make_jaxpr(lambda layers, x: Network(self, layers)(x))
        flops = 0
        for step in program(self.shapes(), abstract(1, len(self.channels), self.window)).eqns:
            if step.primitive.name == "dot_general":
                # Each number of the result is a sum over the axes that both factors share.
                (summed, _), _ = step.params["dimension_numbers"]
                shape: Any = step.invars[0].aval.shape
                flops += 2 * step.outvars[0].aval.size * prod(shape[axis] for axis in summed)
        return int(flops)


POSNET = NetworkConfig(
    channels=COMMAND_COLUMNS,
    outputs=(ANGLE,),
    layers=(
        Conv1D(filters=128, kernel=5),
        Conv1D(filters=64, kernel=3),
        Flatten(),
        Dense(units=128),
        Dense(units=64),
        Dense(units=1, activation="linear"),
    ),
)
"""PosNet: maps the last second of commands to the angle one sample later; 113,601 parameters, as in
Table I."""

FORCENET = NetworkConfig(
    channels=(ANGLE, *COMMAND_COLUMNS),
    outputs=FORCES,
    layers=(
        LSTM(units=128, sequence=True),
        MeanPool(),
        Dense(units=64),
        Dense(units=64),
        Dropout(rate=0.4),
        Dense(units=2, activation="linear"),
    ),
)
"""ForceNet: maps the last second of motion and commands to the force one sample later; 129,794
parameters, as in Table I. The published weights have a second LSTM layer instead of the mean."""


class Network(eqx.Module):
    """A network with its weights."""

    config: NetworkConfig = eqx.field(static=True)
    layers: tuple[Parameters, ...]

    def __call__(
        self, windows: Float[Array, "batch channels window"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch outputs"]:
        """Map scaled windows to scaled outputs; with a key, for training, dropout is active."""
        x = windows
        for index, (layer, parameters) in enumerate(
            zip(self.config.layers, self.layers, strict=True)
        ):
            if isinstance(layer, Dropout) and key is not None:
                keep = jax.random.bernoulli(jax.random.fold_in(key, index), 1 - layer.rate, x.shape)
                x = jnp.where(keep, x / (1 - layer.rate), 0)
            else:
                x = layer.apply(parameters, x)
        return x

    def over_table(
        self, table: Float[np.ndarray, "rows channels"]
    ) -> Float[np.ndarray, "predicted outputs"]:
        """Return the scaled output for every row after the first window: window i is rows i .. i+99
        and predicts row i+100."""
        count = len(table) - self.config.window
        on_device = jnp.asarray(table)
        parts = [
            np.asarray(_chunk(self, on_device, jnp.int32(first)))
            for first in range(0, count, MAX_CHUNK_WINDOWS)
        ]
        return np.concatenate(parts)[:count]

    @classmethod
    def create(cls, config: NetworkConfig, key: PRNGKeyArray) -> "Network":
        """Return new weights: Glorot-uniform, recurrent ones orthogonal, forget gates open (Keras's
        defaults)."""
        draw = {
            "kernel": jax.nn.initializers.glorot_uniform(),
            "recurrent": jax.nn.initializers.orthogonal(),
            "bias": lambda _, shape: jnp.zeros(shape),
        }
        layers = []
        for index, (layer, shapes) in enumerate(zip(config.layers, config.shapes(), strict=True)):
            layer_key = jax.random.fold_in(key, index)
            parameters = {}
            for number, (name, like) in enumerate(shapes.items()):
                parameters[name] = draw[name](jax.random.fold_in(layer_key, number), like.shape)
            if isinstance(layer, LSTM):
                parameters["bias"] = parameters["bias"].at[layer.units : 2 * layer.units].set(1.0)
            layers.append(parameters)
        return cls(config, tuple(layers))


def gather(
    table: Float[Array, "rows channels"], starts: Int[Array, "batch"], window: int
) -> Float[Array, "batch channels window"]:
    """Return the windows of a table that begin at `starts`."""
    taken = jax.vmap(lambda start: jax.lax.dynamic_slice_in_dim(table, start, window))(starts)
    return jnp.swapaxes(taken, 1, 2)


@eqx.filter_jit
def _chunk(
    network: Network, table: Float[Array, "rows channels"], first: Int[Array, ""]
) -> Float[Array, "chunk out"]:
    # The last chunk repeats the last window, so that one compiled program serves all chunks.
    starts = jnp.minimum(
        first + jnp.arange(MAX_CHUNK_WINDOWS), table.shape[0] - 1 - network.config.window
    )
    return network(gather(table, starts, network.config.window))
