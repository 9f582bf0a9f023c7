"""Networks whose input is a window of past samples, built from their configuration.

As in the published weights (paper Sec. III-B), the first layer sees a window (channels, samples) as
a sequence of `channels` steps with `samples` features each. Convolutions and LSTMs therefore run
over the channels, not over time.
"""

from collections.abc import Callable
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
"""Number of windows per batch in `Network.over_table`: large enough for efficient matrix products,
and small enough for the caches."""

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
    """Return a placeholder for a float32 array."""
    return cast(Any, jax.ShapeDtypeStruct)(shape, jnp.float32)


class BaseLayer(Configuration):
    """Base class of layers; this layer returns its input.

    Layers process a batch with a few large matrix products, which is faster than mapping an Equinox
    layer over the examples.
    """

    def shapes(self, example: Shape) -> Shapes:
        """Return the shape of each parameter, by name, for inputs with the shape `example`."""
        return {}

    def apply(self, parameters: Parameters, x: Float[Array, "batch *example"]) -> Array:
        """Return the output of the layer for a batch."""
        return x


class Conv1D(BaseLayer):
    """Convolution over the steps with stride 1, zero-padded to the same length."""

    kind: Literal["conv1d"] = "conv1d"
    filters: PositiveInt
    kernel: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> Shapes:
        """Return the shapes of the kernel (taps, features, filters) and the bias."""
        return {
            "kernel": abstract(self.kernel, example[1], self.filters),
            "bias": abstract(self.filters),
        }

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """Compute the convolution as one product with a block matrix.

        The sequences are not longer than the kernel, so almost no block of the matrix is zero.
        """
        batch, steps, features = x.shape
        kernel = parameters["kernel"]
        # As in the padding "same" of Keras, an even kernel extends one step further to the right.
        left = (self.kernel - 1) // 2
        empty = jnp.zeros((features, self.filters), kernel.dtype)

        def block(tap: int) -> Array:
            return kernel[tap] if 0 <= tap < self.kernel else empty

        # y[target] = sum over source of x[source] kernel[source - target + left]. A step of one fin
        # is an eighth faster if the matrix is built from blocks instead of by indexing the kernel.
        def row(source: int) -> list[Array]:
            return [block(source - target + left) for target in range(steps)]

        matrix = jnp.block([row(source) for source in range(steps)])
        y = (x.reshape(batch, steps * features) @ matrix).reshape(batch, steps, self.filters)
        return ACTIVATIONS[self.activation](y + parameters["bias"])


class LSTM(BaseLayer):
    """Long short-term memory (Hochreiter and Schmidhuber 1997). The order of the gates is the same
    as in Keras: input, forget, cell, output."""

    kind: Literal["lstm"] = "lstm"
    units: PositiveInt
    sequence: bool = False
    """Whether to return the hidden states of all steps instead of only the last step."""

    def shapes(self, example: Shape) -> Shapes:
        """Return the shapes of the kernel (features, gates), recurrent kernel (units, gates) and
        bias."""
        gates = 4 * self.units
        kernels = {"kernel": abstract(example[1], gates), "recurrent": abstract(self.units, gates)}
        return {**kernels, "bias": abstract(gates)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch steps features"]) -> Array:
        """Compute one matrix product per step for the concatenated input and hidden state.

        The first step starts from a zero state, so it needs neither the forget gate nor the
        recurrent kernel.
        """
        kernel = parameters["kernel"]
        bias = parameters["bias"]
        both = jnp.concatenate([kernel, parameters["recurrent"]])
        # (i, f, g, o) = W [x, h] + b
        # c' = sigmoid(f) c + sigmoid(i) tanh(g)
        # h' = sigmoid(o) tanh(c')
        first_gates = x[:, 0] @ self._without_forget(kernel) + self._without_forget(bias)
        i, g, o = jnp.split(first_gates, 3, axis=-1)
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
        """Return the mean, (batch, features)."""
        return x.mean(axis=1)


class Flatten(BaseLayer):
    """Flattens steps and features into one axis."""

    kind: Literal["flatten"] = "flatten"

    def apply(self, parameters: Parameters, x: Float[Array, "batch ..."]) -> Array:
        """Return the flattened features, (batch, steps * features)."""
        return x.reshape(x.shape[0], -1)


class Dense(BaseLayer):
    """A fully connected layer."""

    kind: Literal["dense"] = "dense"
    units: PositiveInt
    activation: Activation = "relu"

    def shapes(self, example: Shape) -> Shapes:
        """Return the shapes of the kernel (features, units) and the bias."""
        return {"kernel": abstract(example[-1], self.units), "bias": abstract(self.units)}

    def apply(self, parameters: Parameters, x: Float[Array, "batch ... features"]) -> Array:
        """Return the activations, (batch, ..., units)."""
        return ACTIVATIONS[self.activation](x @ parameters["kernel"] + parameters["bias"])


class Dropout(BaseLayer):
    """Dropout (Srivastava et al. 2014). `Network.__call__` applies dropout during training;
    otherwise, the layer returns its input."""

    kind: Literal["dropout"] = "dropout"
    rate: float = Field(ge=0, lt=1)


Layer = Annotated[Conv1D | LSTM | MeanPool | Flatten | Dense | Dropout, Field(discriminator="kind")]


class NetworkConfig(Configuration):
    """Channels and layers of a network."""

    channels: tuple[str, ...]
    """Names of the input channels, in the order of the sequence."""
    outputs: tuple[str, ...]
    """Names of the output channels."""
    window: PositiveInt = 100
    """Number of past samples in the input [samples at 100 Hz]; the paper uses 1 s."""
    layers: tuple[Layer, ...]

    def shapes(self) -> tuple[Shapes, ...]:
        """Return the shapes of the parameters of each layer."""
        example: Shape = (len(self.channels), self.window)
        shapes = []
        for layer in self.layers:
            shapes.append(layer.shapes(example))
            # The output of this layer is the input of the next one.
            output = jax.eval_shape(layer.apply, shapes[-1], abstract(1, *example))
            example = output.shape[1:]
        return tuple(shapes)

    def parameters(self) -> int:
        """Return the number of trainable parameters."""
        return sum(shape.size for layer in self.shapes() for shape in layer.values())


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
"""PosNet, which predicts the next angle from the last second of commands. It has 113,601
parameters, as in Table I."""

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
"""ForceNet, which predicts the next force from the last second of angles and commands. It has
129,794 parameters, as in Table I. The published weights have a second LSTM layer instead of the
mean."""


class Network(eqx.Module):
    """A network and its weights."""

    config: NetworkConfig = eqx.field(static=True)
    layers: tuple[Parameters, ...]

    def __call__(
        self, windows: Float[Array, "batch channels window"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch outputs"]:
        """Map scaled windows to scaled outputs. Dropout is active only if a key is given, as in
        training."""
        x = windows
        for index, (layer, parameters) in enumerate(
            zip(self.config.layers, self.layers, strict=True)
        ):
            if isinstance(layer, Dropout) and key is not None:
                # Inverted dropout: dividing by the probability to keep preserves the mean.
                keep = jax.random.bernoulli(jax.random.fold_in(key, index), 1 - layer.rate, x.shape)
                x = jnp.where(keep, x / (1 - layer.rate), 0)
            else:
                x = layer.apply(parameters, x)
        return x

    def over_table(
        self, table: Float[np.ndarray, "rows channels"]
    ) -> Float[np.ndarray, "predicted outputs"]:
        """Predict every row of a scaled table after the first window.

        Window i covers rows i to i + window - 1 and predicts row i + window.
        """
        count = len(table) - self.config.window
        on_device = jnp.asarray(table)
        starts = range(0, count, MAX_CHUNK_WINDOWS)
        parts = [np.asarray(_chunk(self, on_device, jnp.int32(first))) for first in starts]
        return np.concatenate(parts)[:count]

    @classmethod
    def create(cls, config: NetworkConfig, key: PRNGKeyArray) -> "Network":
        """Initialize a network with the defaults of Keras: Glorot-uniform kernels, orthogonal
        recurrent kernels, and biases of 0."""
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
                # As with unit_forget_bias in Keras, the forget gates are initially open.
                parameters["bias"] = parameters["bias"].at[layer.units : 2 * layer.units].set(1.0)
            layers.append(parameters)
        return cls(config, tuple(layers))


def gather(
    table: Float[Array, "rows channels"], starts: Int[Array, "batch"], window: int
) -> Float[Array, "batch channels window"]:
    """Return the windows of a table that start at the rows `starts`."""
    taken = jax.vmap(lambda start: jax.lax.dynamic_slice_in_dim(table, start, window))(starts)
    return jnp.swapaxes(taken, 1, 2)


@eqx.filter_jit
def _chunk(
    network: Network, table: Float[Array, "rows channels"], first: Int[Array, ""]
) -> Float[Array, "chunk out"]:
    # The last chunk is padded with copies of the last window so that one compiled program runs all
    # chunks. `over_table` drops the copies.
    starts = jnp.minimum(
        first + jnp.arange(MAX_CHUNK_WINDOWS), table.shape[0] - 1 - network.config.window
    )
    return network(gather(table, starts, network.config.window))
