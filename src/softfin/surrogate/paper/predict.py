"""A whole log through both nets, window by window: window i is rows i .. i+99 and predicts row i+100."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from softfin.core.quantities import Log
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.network import Network
from softfin.surrogate.paper.posnet import COMMANDS
from softfin.surrogate.paper.scaling import Scaling
from softfin.surrogate.paper.surrogate import ANGLE, Surrogate

CHUNK = 2048
"""Windows a call: large enough for the matrix products, small enough for the caches."""

Motion = Literal["measured", "free-running"]


class Prediction(NamedTuple):
    """What the nets say of a log's rows from `window` on; NumPy, physical units."""

    angle: Float[np.ndarray, "predicted"]
    force: Float[np.ndarray, "predicted 2"]


def channels_of(log: Log) -> dict[str, Float[np.ndarray, "rows"]]:
    """The columns of a log by the names that the nets use."""
    return {
        COMMANDS[0]: np.asarray(log.command.angle, np.float32),
        COMMANDS[1]: np.asarray(log.command.velocity, np.float32),
        ANGLE: np.asarray(log.reading.angle, np.float32),
        **{name: np.asarray(log.reading.force[:, axis], np.float32) for axis, name in enumerate(FORCES)},
    }


def scaled_table(scaling: Scaling, names: tuple[str, ...], log: Log) -> Float[np.ndarray, "rows channels"]:
    """Some columns of a log, scaled, float32."""
    columns = channels_of(log)
    return np.stack([scaling.scaled(name, columns[name]) for name in names], axis=1).astype(np.float32)


def gather(
    table: Float[Array, "rows channels"], starts: Int[Array, "batch"], window: int
) -> Float[Array, "batch channels window"]:
    """The windows of a table that begin at `starts`."""
    channels = table.shape[1]

    def take(start: Int[Array, ""]) -> Float[Array, "window channels"]:
        return jax.lax.dynamic_slice(table, (start, 0), (window, channels))

    return jnp.swapaxes(jax.vmap(take)(starts), 1, 2)


@eqx.filter_jit
def _chunk(network: Network, table: Float[Array, "rows channels"], first: Int[Array, ""]) -> Float[Array, "chunk out"]:
    starts = jnp.minimum(first + jnp.arange(CHUNK), table.shape[0] - 1 - network.config.window)
    return network(gather(table, starts, network.config.window))


def over_table(network: Network, table: Float[np.ndarray, "rows channels"]) -> Float[np.ndarray, "predicted outputs"]:
    """The net's scaled output for every row behind the first window."""
    count = len(table) - network.config.window
    on_device = jnp.asarray(table)
    parts = [np.asarray(_chunk(network, on_device, jnp.int32(first))) for first in range(0, count, CHUNK)]
    return np.concatenate(parts)[:count]


def predict(surrogate: Surrogate, log: Log, motion: Motion = "free-running") -> Prediction:
    """Angles from the commands, forces from those angles (or from the measured ones) and the commands.

    Free-running, the first window's angles are the measured ones: nothing was predicted for them.
    """
    scaling, window = surrogate.scaling, surrogate.window
    table = scaled_table(scaling, (ANGLE, *COMMANDS), log)
    angle = over_table(surrogate.posnet, table[:, 1:])
    if motion == "free-running":
        table = np.concatenate([np.concatenate([table[:window, :1], angle]), table[:, 1:]], axis=1)
    force = over_table(surrogate.forcenet, table)
    return Prediction(
        np.asarray(scaling.physical([ANGLE], jnp.asarray(angle)))[:, 0],
        np.asarray(scaling.physical(FORCES, jnp.asarray(force))),
    )
