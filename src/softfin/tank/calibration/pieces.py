"""Pieces of logs, all equally long, as arrays: what a tank is to repeat, and what it is compared with."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.errors import LogError
from softfin.core.plant import Plant
from softfin.core.quantities import RATE_HZ, Command, Log, Reading
from softfin.core.randomness import key_of
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate

CHANNELS = ("angle", "force_x", "force_y")


class Pieces(eqx.Module):
    """Commands, and the readings that follow them: ``measured[:, k]`` comes one tick after ``command.angle[:, k]``."""

    command: Command
    """Fields ``(pieces, ticks)``."""
    measured: Float[Array, "pieces ticks channels"]
    """In the order of `CHANNELS` [rad, N, N]."""
    warm_up: int = eqx.field(static=True)
    """Ticks at the start of each piece that are not compared."""

    @property
    def compared(self) -> Float[Array, "pieces compared channels"]:
        """What is measured behind the warm-up."""
        return self.measured[:, self.warm_up :]

    @property
    def deviation(self) -> Float[Array, "channels"]:
        """Standard deviation of each channel over all pieces, about one mean."""
        return jnp.std(self.compared, axis=(0, 1))


def cut(logs: Sequence[Log], count: int, rows: int, warm_up: int, part: str) -> Pieces:
    """Pieces of `rows` readings, from all logs in turn; fewer than `count` where the logs hold no more.

    Raises:
        LogError: no log is long enough for one piece, or a channel never changes.
    """
    places = [
        (index, start)
        for start in range(0, max((len(log.reading.time) for log in logs), default=0) - rows, rows)
        for index, log in enumerate(logs)
        if start + rows < len(log.reading.time)
    ]
    if not places:
        raise LogError(f"{part} logs: none has {rows + 1} rows, one piece of {rows / RATE_HZ:g} s; lower piece_s")
    taken = [(logs[index], start) for index, start in places[:count]]
    command = [
        jax.tree.map(lambda x, start=start: np.asarray(x[start : start + rows], np.float32), log.command)
        for log, start in taken
    ]
    measured = [channels(log.reading)[start + 1 : start + 1 + rows] for log, start in taken]
    pieces = Pieces(
        Command(*(jnp.stack(channel) for channel in zip(*command, strict=True))), jnp.stack(measured), warm_up
    )
    for channel, deviation in zip(CHANNELS, np.asarray(pieces.deviation).tolist(), strict=True):
        if deviation == 0:
            raise LogError(f"{part} logs: {channel} never changes, so nothing can be fitted to it; record motion")
    return pieces


def channels(reading: Reading) -> Float[np.ndarray, "rows channels"]:
    """The readings of a log in the order of `CHANNELS`."""
    return np.concatenate([np.asarray(reading.angle)[:, None], np.asarray(reading.force)], axis=1, dtype=np.float32)


def excited(plant: Plant, count: int, rows: int, excitation: ExcitationConfig, seed: int, part: str) -> list[Log]:
    """Logs of a plant under random commands; `part` and `seed` decide which."""
    keys = [key_of(seed, f"calibrate/{part}/{index}") for index in range(count)]
    return list(simulate([plant] * count, keys, rows, excitation, count, lambda done: None))
