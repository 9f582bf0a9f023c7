"""Networks over a window of samples, described by their configuration: channels are the steps, the window the features.

This is the layout of the published weights (paper Sec. III-B): a window (channels, samples) goes into the first layer
as a sequence of `channels` steps with `samples` features each.
"""

from math import prod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError
from softfin.surrogate.channels import ANGLE, COMMANDS, FORCES
from softfin.surrogate.paper.layers import LSTM, Conv1D, Dense, Dropout, Flatten, Layer, MeanPool, Parameters, Shape

CHUNK = 2048
"""Windows that a net takes at once from a table: enough for the matrix products, few enough for the caches."""


class NetworkConfig(Configuration):
    """Channels of a network and its layers."""

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
        """Shapes of each layer's parameters."""
        return [layer.shapes(example) for layer, example in zip(self.layers, self.examples(), strict=False)]

    def parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(prod(shape) for layer in self.shapes() for shape in layer.values())

    def flops(self) -> int:
        """Floating-point operations of the matrix products for one window, two a multiply-add."""
        return 2 * sum(layer.products(x) for layer, x in zip(self.layers, self.examples(), strict=False))


POSNET = NetworkConfig(
    channels=COMMANDS,
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
"""PosNet: the last second of commands in, the angle one sample later out; 113,601 parameters, as in Table I."""

FORCENET = NetworkConfig(
    channels=(ANGLE, *COMMANDS),
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
"""ForceNet: the last second of motion and commands in, the force one sample later out; 129,794 parameters, as in
Table I. The published weights have a second LSTM layer instead of the mean."""


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

    def over_table(self, table: Float[np.ndarray, "rows channels"]) -> Float[np.ndarray, "predicted outputs"]:
        """Scaled output for every row behind the first window: window i is rows i .. i+99 and predicts row i+100."""
        count = len(table) - self.config.window
        on_device = jnp.asarray(table)
        parts = [np.asarray(_chunk(self, on_device, jnp.int32(first))) for first in range(0, count, CHUNK)]
        return np.concatenate(parts)[:count]

    def arrays(self) -> dict[str, np.ndarray]:
        """The weights by name: ``3.kernel`` is the kernel of the fourth layer."""
        return {f"{i}.{name}": np.asarray(a) for i, layer in enumerate(self.layers) for name, a in layer.items()}

    @classmethod
    def create(cls, config: NetworkConfig, key: PRNGKeyArray) -> "Network":
        """Fresh weights: Glorot-uniform, recurrent ones orthogonal, forget gates open (Keras's defaults)."""
        draw = {"kernel": jax.nn.initializers.glorot_uniform(), "recurrent": jax.nn.initializers.orthogonal(),
                "bias": lambda _, shape: jnp.zeros(shape)}  # fmt: skip
        layers = []
        for index, (layer, shapes) in enumerate(zip(config.layers, config.shapes(), strict=True)):
            keys = [jax.random.fold_in(jax.random.fold_in(key, index), number) for number in range(len(shapes))]
            parameters = {name: draw[name](one, shape) for one, (name, shape) in zip(keys, shapes.items(), strict=True)}
            if isinstance(layer, LSTM):
                parameters["bias"] = parameters["bias"].at[layer.units : 2 * layer.units].set(1.0)
            layers.append(parameters)
        return cls(config, tuple(layers))

    @classmethod
    def of(cls, config: NetworkConfig, arrays: dict[str, np.ndarray], source: str) -> "Network":
        """A network with named weights; raises ArtifactError where one is missing, odd or of another shape."""
        expected = {f"{i}.{name}": shape for i, layer in enumerate(config.shapes()) for name, shape in layer.items()}
        for name in sorted(set(expected) ^ set(arrays)):
            what = "is missing" if name in expected else "is not in the configuration"
            raise ArtifactError(f"{source}: weight {name} {what}; copy the whole folder again")
        for name, shape in expected.items():
            if arrays[name].shape != shape:
                raise ArtifactError(f"{source}: weight {name} has shape {arrays[name].shape}; it must be {shape}")
            if not np.isfinite(arrays[name]).all():
                raise ArtifactError(f"{source}: weight {name} is not finite; train again")
        layers = [
            {name: jnp.asarray(arrays[f"{index}.{name}"], jnp.float32) for name in shapes}
            for index, shapes in enumerate(config.shapes())
        ]
        return cls(config, tuple(layers))


def gather(
    table: Float[Array, "rows channels"], starts: Int[Array, "batch"], window: int
) -> Float[Array, "batch channels window"]:
    """The windows of a table that begin at `starts`."""

    def take(start: Int[Array, ""]) -> Float[Array, "window channels"]:
        return jax.lax.dynamic_slice(table, (start, 0), (window, table.shape[1]))

    return jnp.swapaxes(jax.vmap(take)(starts), 1, 2)


@eqx.filter_jit
def _chunk(network: Network, table: Float[Array, "rows channels"], first: Int[Array, ""]) -> Float[Array, "chunk out"]:
    starts = jnp.minimum(first + jnp.arange(CHUNK), table.shape[0] - 1 - network.config.window)
    return network(gather(table, starts, network.config.window))
