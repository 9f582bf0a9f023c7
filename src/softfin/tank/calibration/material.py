"""Where the logs of a calibration come from: a dataset's files, or a plant that is moved for the purpose."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.action_clock import ticks_of
from softfin.core.errors import ArtifactError, ConfigurationError
from softfin.core.plant import Plant, State, hold
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ, Command, Limits, Log, Reading
from softfin.core.randomness import key_of
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.pieces import Pieces, channels, excited

CENTRES = np.linspace(-1.0, 1.0, 9, dtype=np.float32)
"""Angles about which a plant is made to beat [rad]."""

SWING = 0.5
"""Amplitude of the commanded angle on either side of the centre [rad], a stroke an action of the 3 Hz clock."""

BEATS = 24
"""Strokes about each centre: 8 s, of which the first 2 s are not counted."""


class Material(NamedTuple):
    """What a tank is fitted to and judged on."""

    train: list[Log]
    test: list[Log]
    beats: Pieces | None
    """One piece about each of `CENTRES`, where there is a plant to beat."""
    metadata: dict[str, Any]
    """What tells it from other material."""


def material(data: str | Path | Plant, config: CalibrateConfig, seed: int) -> Material:
    """Return the logs of a dataset's folder, a surrogate's folder, a plant by its name, or a plant.

    Raises:
        ArtifactError: a folder that is neither, or a dataset without test logs.
        ConfigurationError: a range of velocities that the plant does not take, or one given for logs.
    """
    if isinstance(data, str | Path):
        path = Path(data)
        if path.is_dir() and not artifacts.is_kind(path, "surrogate"):
            return _of_dataset(path, config)
        return _of_plant(find_plant(str(data)), config, seed)
    return _of_plant(data, config, seed)


def _of_dataset(path: Path, config: CalibrateConfig) -> Material:
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
    rows = round(config.piece_s * RATE_HZ) + 1
    train, test = (
        excited(within, count, rows, config.excitation, seed, part)
        for part, count in (("train", config.pieces), ("test", config.test_pieces))
    )
    return Material(train, test, _beats(within, seed), {"plant": identity(plant)})


class _Within:
    """A plant that is commanded in a part of its range."""

    def __init__(self, plant: Plant, limits: Limits) -> None:
        self._plant = plant
        self.limits = limits

    def init(self, key: Any) -> State:
        return self._plant.init(key)

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


def _beats(plant: Plant, seed: int) -> Pieces:
    """At nine tenths of the greatest velocity, so that a stroke is done when the next begins."""
    limits = plant.limits
    signs = SWING * (-1.0) ** np.arange(BEATS, dtype=np.float32)
    angle = np.clip(CENTRES[:, None] + signs, limits.angle_min, limits.angle_max).astype(np.float32)
    actions = Command(jnp.asarray(angle), jnp.full(angle.shape, 0.9 * limits.velocity_max, jnp.float32))
    key = key_of(seed, "calibrate/beats")
    _, reading = jax.jit(jax.vmap(lambda command: hold(plant, plant.init(key), command)))(actions)
    ticks = ticks_of(BEATS)
    command = jax.tree.map(lambda x: jnp.asarray(np.repeat(np.asarray(x), ticks, axis=1)), actions)
    measured = np.stack([channels(jax.tree.map(lambda x, i=i: x[i], reading)) for i in range(len(CENTRES))])
    return Pieces(command, jnp.asarray(measured), 2 * RATE_HZ)
