"""What a tank is fitted to: logs of a dataset or of a plant that is moved for the purpose, in equal segments."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import ticks_of
from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.core.plant import Plant, State, hold
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ, Command, Limits, Log, Reading
from softfin.core.randomness import key_of
from softfin.data.simulate import simulate
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.tank.calibration.config import CalibrateConfig

CHANNELS = ("angle", "force_x", "force_y")

CENTRES = np.linspace(-1.0, 1.0, 9, dtype=np.float32)
"""Angles about which a plant is made to beat [rad]."""

SWING = 0.5
"""Amplitude of the commanded angle on either side of the centre [rad], a stroke an action of the 3 Hz clock."""

STROKES = 24
"""Strokes about each centre: 8 s, of which the first 2 s are not counted."""


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


class Material(NamedTuple):
    """What a tank is fitted to and judged on."""

    train: list[Log]
    test: list[Log]
    gaits: Segments | None
    """One segment of beating about each of `CENTRES`, where there is a plant to move."""
    metadata: dict[str, Any]
    """What tells it from other material: hash of the data or identity of the plant."""


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
    measured = jnp.stack([_channels(log.reading)[1:][rows] for log, rows in places])
    segments = Segments(Command(*command), measured, warm_up)
    for channel, deviation in zip(CHANNELS, np.asarray(segments.deviation).tolist(), strict=True):
        if deviation == 0:
            raise LogError(f"{part} logs: {channel} never changes, so nothing can be fitted to it; record motion")
    return segments


def material(data: str | Path | Plant, config: CalibrateConfig, seed: int) -> Material:
    """Return the logs of a dataset's folder, a surrogate's folder, a plant by its name, or a plant.

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
    return Material(train, test, None, {"data_hash": dataset.data_hash})


def _of_plant(plant: Plant, config: CalibrateConfig, seed: int) -> Material:
    within = _Within(plant, _limits(plant, config))
    rows = round(config.segment_s * RATE_HZ) + 1

    def excited(part: str, count: int) -> list[Log]:
        keys = [key_of(seed, f"calibrate/{part}/{index}") for index in range(count)]
        return list(simulate([within] * count, keys, rows, config.excitation, count, lambda done: None))

    train, test = excited("train", config.segments), excited("test", config.test_segments)
    return Material(train, test, _gaits(within, seed), {"plant": identity(plant)})


class _Within:
    """A plant that is commanded in a part of its range."""

    def __init__(self, plant: Plant, limits: Limits) -> None:
        self.init = plant.init
        self._plant = plant
        self.limits = limits

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        return self._plant.advance(state, command, ticks)


def _limits(plant: Plant, config: CalibrateConfig) -> Limits:
    limits = Limits(*plant.limits)
    if config.velocity_rad_s is None:
        return limits
    low, high = config.velocity_rad_s
    if not limits.velocity_min - 1e-6 <= low < high <= limits.velocity_max + 1e-3:
        raise ConfigurationError(
            f"velocity_rad_s = {low:g}, {high:g}: the plant takes {limits.velocity_min:g} to "
            f"{limits.velocity_max:g} rad/s; give a range within, the lower first"
        )
    return limits._replace(velocity_min=low, velocity_max=min(high, limits.velocity_max))


def _gaits(plant: Plant, seed: int) -> Segments:
    """Beat about each centre at nine tenths of the greatest velocity, so that a stroke is done when the next begins."""
    limits = plant.limits
    signs = SWING * (-1.0) ** np.arange(STROKES, dtype=np.float32)
    angle = np.clip(CENTRES[:, None] + signs, limits.angle_min, limits.angle_max).astype(np.float32)
    actions = Command(jnp.asarray(angle), jnp.full(angle.shape, 0.9 * limits.velocity_max, jnp.float32))
    key = key_of(seed, "calibrate/beats")
    _, reading = jax.jit(jax.vmap(lambda command: hold(plant, plant.init(key), command)))(actions)
    command = jax.tree.map(lambda x: jnp.asarray(np.repeat(np.asarray(x), ticks_of(STROKES), axis=1)), actions)
    return Segments(command, jnp.asarray(_channels(reading)), 2 * RATE_HZ)


def _channels(reading: Reading) -> Float[np.ndarray, "*rows channels"]:
    """Stack readings in the order of `CHANNELS`."""
    return np.concatenate([np.asarray(reading.angle)[..., None], np.asarray(reading.force)], axis=-1, dtype=np.float32)
