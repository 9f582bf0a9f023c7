"""What a tank is fitted to: logs of a dataset or of a plant that is moved for the purpose, in equal segments."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ, Command, Limits, Log
from softfin.core.randomness import key_of
from softfin.data.simulate import simulate
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.tank.calibration.config import CalibrateConfig

CHANNELS = ("angle", "force_x", "force_y")


class Segments(eqx.Module):
    """Commands, and the readings that follow them: ``measured[:, k]`` comes one tick after ``command.angle[:, k]``."""

    command: Command
    """Fields ``(segments, ticks)``."""
    measured: Float[Array, "segments ticks channels"]
    """Readings in the order of `CHANNELS` [rad, N, N]."""
    warm_up: int = eqx.field(static=True)
    """Ticks at the start of each segment that are not compared."""

    @property
    def compared(self) -> Float[Array, "segments compared channels"]:
        """Readings behind the warm-up."""
        return self.measured[:, self.warm_up :]

    @property
    def deviation(self) -> Float[Array, "channels"]:
        """Standard deviation of each channel over all segments, about one mean."""
        return jnp.std(self.compared, axis=(0, 1))


def cut(logs: Sequence[Log], count: int, rows: int, warm_up: int, part: str) -> Segments:
    """Cut segments of `rows` readings, from all logs in turn; fewer than `count` where the logs hold no more.

    Raises:
        LogError: no log is long enough for one segment, or a channel never changes.
    """
    places = [
        (log, slice(start, start + rows))
        for start in range(0, max((len(log.reading.time) for log in logs), default=0) - rows, rows)
        for log in logs
        if start + rows < len(log.reading.time)
    ][:count]
    if not places:
        raise LogError(f"{part} logs: none has {rows + 1} rows, one segment of {rows / RATE_HZ:g} s; lower segment_s")
    command = (jnp.stack([np.asarray(log.command[i][rows], np.float32) for log, rows in places]) for i in range(2))
    readings = [np.column_stack([log.reading.angle, log.reading.force])[1:][rows] for log, rows in places]
    segments = Segments(Command(*command), jnp.asarray(np.stack(readings), np.float32), warm_up)
    for channel, deviation in zip(CHANNELS, np.asarray(segments.deviation).tolist(), strict=True):
        if deviation == 0:
            raise LogError(f"{part} logs: {channel} never changes, so nothing can be fitted to it; record motion")
    return segments


def material(
    data: str | Path | Plant, config: CalibrateConfig, seed: int
) -> tuple[list[Log], list[Log], dict[str, Any]]:
    """Return training logs, test logs and what tells them from others: the data's hash or the plant's identity.

    They are those of a dataset's folder, or of a plant: a surrogate's folder, its name, or itself.

    Raises:
        ArtifactError: a folder that is neither, or a dataset without test logs.
        ConfigurationError: a range of velocities that the plant does not take, or one given for logs.
    """
    if not isinstance(data, str | Path):
        return _of_plant(data, config, seed)
    path = Path(data)
    if not path.is_dir() or artifacts.is_kind(path, "surrogate"):
        return _of_plant(find_plant(str(data)), config, seed)
    if config.velocity_rad_s is not None:
        raise ConfigurationError(f"--velocity: {path} is a dataset, which brings its own commands; leave it out")
    dataset = Dataset.open(path)
    if not dataset.test:
        raise ArtifactError(
            f"{path}: holds no test logs to judge the fit on; put some of the logs into {path / 'test'}"
        )
    train, test = (list(dataset.load(part)) for part in (dataset.train, dataset.test))
    return train, test, {"data_hash": dataset.data_hash}


def _of_plant(plant: Plant, config: CalibrateConfig, seed: int) -> tuple[list[Log], list[Log], dict[str, Any]]:
    limits = Limits(*plant.limits)
    if config.velocity_rad_s is not None:
        low, high = config.velocity_rad_s
        if not limits.velocity_min - 1e-6 <= low < high <= limits.velocity_max + 1e-3:
            raise ConfigurationError(
                f"velocity_rad_s = {low:g}, {high:g}: the plant takes {limits.velocity_min:g} to "
                f"{limits.velocity_max:g} rad/s; give a range within, the lower first"
            )
        limits = limits._replace(velocity_min=low, velocity_max=min(high, limits.velocity_max))
    within = cast(Plant, SimpleNamespace(init=plant.init, advance=plant.advance, limits=limits))

    def excited(part: str, count: int) -> list[Log]:
        keys = [key_of(seed, f"calibrate/{part}/{index}") for index in range(count)]
        rows = round(config.segment_s * RATE_HZ) + 1
        return list(simulate([within] * count, keys, rows, config.excitation, count, lambda done: None))

    return excited("train", config.segments), excited("test", config.test_segments), {"plant": identity(plant)}
