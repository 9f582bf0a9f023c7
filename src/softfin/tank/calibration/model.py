"""The data for the fit of a tank, and one compiled program that runs many tanks over them: points
in, residuals out.

Logs of a dataset, or of a plant that is excited for the fit, are cut into equal segments. R2 of a
channel is pooled: 1 - (sum of squared errors) / (sum of squared deviations from the mean), both
sums and the mean over all compared ticks of all segments together.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, roll
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ, Command, Limits, Log
from softfin.core.randomness import named_key
from softfin.data.simulate import simulate
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.registry import find_plant
from softfin.tank import Tank, TankConfig
from softfin.tank.calibration.config import (
    CalibrateConfig,
    CalibrationPoint,
    Parameter,
    RecordingConfig,
)
from softfin.tank.sensor import config_arrays

FITTED_CHANNELS = ("angle", "force_x", "force_y")


class Segments(eqx.Module):
    """Commands, and the readings that follow them: ``measured[:, k]`` comes one tick after
    ``command.angle[:, k]``."""

    command: Command
    """Fields ``(segments, ticks)``."""
    measured: Float[Array, "segments ticks channels"]
    """Readings in the order of `FITTED_CHANNELS` [rad, N, N]."""
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


def cut(logs: Sequence[Log], count: int, rows: int, warm_up: int, split: str) -> Segments:
    """Cut segments of `rows` readings, from all logs in turn; fewer than `count` if the logs are
    too short."""
    longest = max((len(log.reading.time) for log in logs), default=0)
    places = [
        (log, slice(start, start + rows))
        for start in range(0, longest - rows, rows)
        for log in logs
        if start + rows < len(log.reading.time)
    ][:count]
    if not places:
        raise LogError(
            f"{split} logs: none has {rows + 1} rows, one segment of {rows / RATE_HZ:g} s; lower "
            "segment_s"
        )
    commands = []
    readings = []
    for log, part in places:
        commands.append(Command(log.command.angle[part], log.command.velocity[part]))
        # The first reading follows no command of the log.
        readings.append(np.column_stack([log.reading.angle, log.reading.force])[1:][part])
    command = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts), np.float32), *commands)
    segments = Segments(command, jnp.asarray(np.stack(readings), np.float32), warm_up)
    for channel, deviation in zip(FITTED_CHANNELS, segments.deviation, strict=True):
        if deviation == 0:
            raise LogError(
                f"{split} logs: {channel} never changes, so nothing can be fitted to it; "
                "record motion"
            )
    return segments


def material(
    data: str | Path | Plant, config: CalibrateConfig, seed: int
) -> tuple[list[Log], list[Log], JsonObject]:
    """Return training logs, test logs and their identity: the data's hash or the plant's identity.

    They are those of a dataset's folder, or of a plant: a surrogate's folder, its name, or itself.
    Raises ArtifactError for other folders, ConfigurationError for velocities outside the plant's
    limits, or if velocities are given for logs.
    """
    if not isinstance(data, str | Path):
        return _of_plant(data, config, seed)
    path = Path(data)
    if not path.is_dir() or artifacts.is_kind(path, "surrogate"):
        return _of_plant(find_plant(str(data)), config, seed)
    if config.velocity_rad_s is not None:
        raise ConfigurationError(
            f"--velocity: {path} is a dataset, which brings its own commands; leave it out"
        )
    dataset = Dataset.open(path)
    if not dataset.test:
        raise ArtifactError(
            f"{path}: holds no test logs to judge the fit on; put some of the logs into "
            f"{path / 'test'}"
        )
    train = list(dataset.load(dataset.train))
    test = list(dataset.load(dataset.test))
    return train, test, {"data_hash": dataset.data_hash}


def _of_plant(
    plant: Plant, config: CalibrateConfig, seed: int
) -> tuple[list[Log], list[Log], JsonObject]:
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
        keys = [named_key(seed, f"calibrate/{part}/{index}") for index in range(count)]
        rows = round(config.segment_s * RATE_HZ) + 1
        return list(
            simulate([within] * count, keys, rows, config.excitation, count, lambda done: None)
        )

    train = excited("train", config.segments)
    test = excited("test", config.test_segments)
    return train, test, {"plant": identity(plant, computed=True)}


Errors = Callable[
    [Sequence[CalibrationPoint]], Iterator[Float[np.ndarray, "segments compared channels"]]
]
"""Function from points to their errors, divided by each channel's standard deviation."""

QUIET = {
    "sensor": {"noise_n": 0.0, "drift_n": 0.0, "resolution_n": 0.0},
    "drive": {"encoder_step_rad": 0.0},
}
"""Return a tank without randomness and quantisation in its readings, which cannot be fitted."""


class Model(NamedTuple):
    """A tank, and by the names of `RecordingConfig` the relation between it and the logs."""

    tank: Plant
    recording: dict[str, Float[Array, "*models"]]

    @classmethod
    def build(cls, tank: TankConfig, recording: RecordingConfig) -> "Model":
        """Return the model of a quiet tank."""
        arrays = dict(zip(RecordingConfig.model_fields, config_arrays(recording), strict=True))
        return cls(Tank(tank.merged(QUIET, "calibration")), arrays)

    def read(self, command: Command) -> Float[Array, "ticks channels"]:
        """Return what a log of this tank would contain, from rest, after each command ``(ticks,)``
        of a log."""
        by = self.recording
        angle = by["angle_gain"] * command.angle + by["angle_offset_rad"]
        velocity = jnp.minimum(by["velocity_factor"] * command.velocity, by["velocity_limit_rad_s"])
        # The readings contain no noise, so the key does not matter.
        _, reading = roll(self.tank, self.tank.init(jax.random.key(0)), Command(angle, velocity))
        angle = by["reading_gain"] * reading.angle + by["reading_offset_rad"]
        force = reading.force + jnp.stack([by["force_x_n"], by["force_y_n"]])
        return jnp.concatenate([angle[:, None], force], axis=1)


def stacked(configs: Sequence[tuple[TankConfig, RecordingConfig]]) -> Model:
    """Stack the models along a new first axis of each array."""
    side_by_side: Model = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(Model.build(*each) for each in configs)
    )
    return side_by_side


@eqx.filter_jit
def read(models: Model, command: Command) -> Float[Array, "models segments ticks channels"]:
    """Return the readings of each stacked model under the commands of each segment."""
    readings: Array = jax.vmap(lambda each: jax.vmap(each.read)(command))(models)
    return readings


@eqx.filter_jit
def _errors(models: Model, segments: Segments) -> Float[Array, "models segments compared channels"]:
    """Return model minus measurement after the warm-up, divided by each channel's standard
    deviation: the mean square is 1 - R2."""
    found: Array = (
        read(models, segments.command)[:, :, segments.warm_up :] - segments.compared
    ) / segments.deviation
    return found


class Space:
    """The box spanned by the free parameters, around a tank and a recording with all other
    numbers."""

    def __init__(
        self, parameters: Sequence[Parameter], tank: TankConfig, recording: RecordingConfig
    ) -> None:
        """Raise ConfigurationError if the box contains invalid values or not its starting point."""
        self.parameters = tuple(parameters)
        self._fixed = {**tank.model_dump(), "recording": recording.model_dump()}
        for parameter in self.parameters:
            value = self._present(parameter)
            name = parameter.name
            if not parameter.low <= value <= parameter.high:
                path = name if name.startswith("recording.") else f"tank.{name}"
                raise ConfigurationError(
                    f"parameters.{name} = [{parameter.low:g}, {parameter.high:g}]: the search "
                    f"starts at {path} = {value:g}, which is outside; widen the range, or set "
                    f"{path}"
                )
            for end in (parameter.low, parameter.high):
                self._built({name: end}, f"parameters.{name}")
        self.start = np.array(
            [parameter.scaled(self._present(parameter)) for parameter in self.parameters]
        )

    def configs(self, point: CalibrationPoint) -> tuple[TankConfig, RecordingConfig]:
        """Return the tank and the recording at a point."""
        values = {p.name: p.value(float(at)) for p, at in zip(self.parameters, point, strict=True)}
        return self._built(values, "calibration")

    def errors(self, segments: Segments, batch: int) -> Errors:
        """Return the function that simulates points against segments, `batch` at a time."""

        def errors(
            points: Sequence[CalibrationPoint],
        ) -> Iterator[Float[np.ndarray, "segments compared channels"]]:
            for start in range(0, len(points), batch):
                some = [self.configs(point) for point in points[start : start + batch]]
                # Padded, so that one compiled program is enough for all calls.
                models = stacked([*some, *some[-1:] * (batch - len(some))])
                yield from np.asarray(_errors(models, segments))[: len(some)]

        return errors

    def _present(self, parameter: Parameter) -> float:
        group, field = parameter.name.split(".")
        return float(self._fixed[group][field])

    def _built(
        self, values: Mapping[str, float], source: str
    ) -> tuple[TankConfig, RecordingConfig]:
        trees = copy.deepcopy(self._fixed)
        for name, value in values.items():
            group, field = name.split(".")
            trees[group][field] = value
        recording = RecordingConfig.build(trees.pop("recording"), source)
        return TankConfig.build(trees, source), recording
