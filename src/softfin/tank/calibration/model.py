"""The calibration data, and a compiled program that simulates many tanks on them and returns the
residuals for each point.

The logs of a dataset, or of a plant that is excited for the fit, are cut into segments of equal
length. The R2 of a channel is 1 - (sum of squared errors) / (sum of squared deviations from the
mean). The sums and the mean are over all compared ticks of all segments.
"""

import copy
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, State, roll
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ, Command, Limits, Log, Reading
from softfin.core.randomness import named_key
from softfin.data.excitation import ExcitationConfig
from softfin.data.recordings import open_logs
from softfin.data.simulate import simulate
from softfin.storage import artifact as artifacts
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
    """Commands and the subsequent readings: ``measured[:, k]`` is read one tick after
    ``command.angle[:, k]`` is issued."""

    command: Command
    """Fields ``(segments, ticks)``."""
    measured: Float[Array, "segments ticks channels"]
    """Readings in the order of `FITTED_CHANNELS` [rad, N, N]."""
    warm_up: int = eqx.field(static=True)
    """Number of ticks at the start of each segment that are not compared."""

    @property
    def compared(self) -> Float[Array, "segments compared channels"]:
        """Readings after the warm-up."""
        return self.measured[:, self.warm_up :]

    @property
    def deviation(self) -> Float[Array, "channels"]:
        """Standard deviation of each channel over all segments."""
        return jnp.std(self.compared, axis=(0, 1))


def cut(logs: Sequence[Log], count: int, rows: int, warm_up: int, split: str) -> Segments:
    """Cut up to `count` segments of `rows` readings out of the logs.

    The first segments of all logs precede the second segments, and so on, so that few segments
    cover many logs.

    Raises:
        LogError: If no log is long enough, or a channel never changes.
    """
    longest = max((len(log.reading.time) for log in logs), default=0)
    starts = range(0, longest - rows, rows)
    # A log must have one more row than the segment, for the reading after the last command.
    places = [
        (log, slice(start, start + rows))
        for start, log in itertools.product(starts, logs)
        if start + rows < len(log.reading.time)
    ]
    if not places:
        raise LogError(
            f"{split} logs: none has the {rows + 1} rows required for a segment of "
            f"{rows / RATE_HZ:g} s; lower segment_s"
        )
    commands = []
    readings = []
    for log, part in places[:count]:
        commands.append(Command(log.command.angle[part], log.command.velocity[part]))
        # Reading k + 1 follows command k.
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


Material = tuple[list[Log], list[Log], JsonObject]
"""Training logs, test logs, and the hash of the data or the plant's identity."""


def material(data: str | Path | Plant, config: CalibrateConfig, seed: int) -> Material:
    """Return what a tank is calibrated from.

    `data` is the folder of a dataset, of recordings (with import options in log.yaml) or of a
    surrogate, or a plant or its name.

    Raises:
        ArtifactError: If there are no test logs.
        LogError: If the folder contains no logs, or logs with errors that are not ignored.
        ConfigurationError: If a velocity range is set for logs, or exceeds the plant's limits.
    """
    if not isinstance(data, str | Path):
        return _of_plant(data, config, seed)
    path = Path(data)
    if not path.is_dir() or artifacts.is_kind(path, "surrogate"):
        return _of_plant(find_plant(str(data)), config, seed)
    if config.velocity_rad_s is not None:
        raise ConfigurationError(
            f"--velocity: {path} is a dataset, which contains its own commands; remove the option"
        )
    opened = open_logs(path)
    opened.check_train(str(path))
    opened.check_issues(str(path))
    if not opened.test:
        raise ArtifactError(
            f"{path}: missing test logs, which are required to evaluate the fit; move some of the "
            f"logs to {path / 'test'}"
        )
    return opened.train, opened.test, {"data_hash": opened.data_hash}


class _Narrowed(eqx.Module):
    """A plant with narrower limits."""

    plant: Plant
    limits: Limits = eqx.field(static=True)

    def init(self, key: PRNGKeyArray) -> State:
        return self.plant.init(key)

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        return self.plant.advance(state, command, ticks)


def _of_plant(plant: Plant, config: CalibrateConfig, seed: int) -> Material:
    limits = Limits(*plant.limits)
    if config.velocity_rad_s is not None:
        low, high = config.velocity_rad_s
        if not limits.velocity_min - 1e-6 <= low < high <= limits.velocity_max + 1e-3:
            raise ConfigurationError(
                f"velocity_rad_s = {low:g}, {high:g}: the plant accepts {limits.velocity_min:g} to "
                f"{limits.velocity_max:g} rad/s; use a range within these limits, lower value first"
            )
        limits = limits._replace(velocity_min=low, velocity_max=min(high, limits.velocity_max))
    within = _Narrowed(plant, limits)

    def excited(part: str, count: int) -> list[Log]:
        keys = [named_key(seed, f"calibrate/{part}/{index}") for index in range(count)]
        rows = round(config.segment_s * RATE_HZ) + 1
        return list(
            simulate([within] * count, keys, rows, ExcitationConfig(), count, lambda done: None)
        )

    train = excited("train", config.segments)
    test = excited("test", config.test_segments)
    return train, test, {"plant": identity(plant)}


Errors = Callable[
    [Sequence[CalibrationPoint]], Iterator[Float[np.ndarray, "segments compared channels"]]
]
"""Function that yields the errors of each point, divided by the standard deviations of the
channels."""

QUIET = {
    "sensor": {"noise_n": 0.0, "drift_n": 0.0, "resolution_n": 0.0},
    "drive": {"encoder_step_rad": 0.0},
}
"""Tank options that remove noise and quantization from the readings; these cannot be fitted."""


class Model(NamedTuple):
    """A tank, and the relation between its readings and logs."""

    tank: Plant
    recording: dict[str, Float[Array, "*models"]]
    """Values, keyed by field name of `RecordingConfig`."""

    @classmethod
    def build(cls, tank: TankConfig, recording: RecordingConfig) -> "Model":
        """Build a model with a tank without noise or quantization."""
        arrays = dict(zip(RecordingConfig.model_fields, config_arrays(recording), strict=True))
        return cls(Tank(tank.merged(QUIET, "calibration")), arrays)

    def read(self, command: Command) -> Float[Array, "ticks channels"]:
        """Simulate the readings that a log of this tank would contain, starting from rest.

        The fields of `command` are commands of a log, ``(ticks,)``.
        """
        by = self.recording
        # Convert from the units and zeros of the log to those of the tank, and back below.
        angle = by["angle_gain"] * command.angle + by["angle_offset_rad"]
        velocity = jnp.minimum(by["velocity_factor"] * command.velocity, by["velocity_limit_rad_s"])
        # The readings contain no noise, so the key does not matter.
        _, reading = roll(self.tank, self.tank.init(jax.random.key(0)), Command(angle, velocity))
        angle = by["reading_gain"] * reading.angle + by["reading_offset_rad"]
        force = reading.force + jnp.stack([by["force_x_n"], by["force_y_n"]])
        return jnp.concatenate([angle[:, None], force], axis=1)


def stacked(configs: Sequence[tuple[TankConfig, RecordingConfig]]) -> Model:
    """Stack models along a new first axis of each array."""
    side_by_side: Model = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(Model.build(*each) for each in configs)
    )
    return side_by_side


@eqx.filter_jit
def read(models: Model, command: Command) -> Float[Array, "models segments ticks channels"]:
    """Return the readings of each stacked model for the commands of each segment."""
    readings: Array = jax.vmap(lambda each: jax.vmap(each.read)(command))(models)
    return readings


@eqx.filter_jit
def _errors(models: Model, segments: Segments) -> Float[Array, "models segments compared channels"]:
    """Return the model errors after the warm-up, divided by the standard deviations of the
    channels; their mean square is 1 - R2."""
    found: Array = (
        read(models, segments.command)[:, :, segments.warm_up :] - segments.compared
    ) / segments.deviation
    return found


class Space:
    """The box of the free parameters, and the tank and recording with the fixed values."""

    def __init__(
        self, parameters: Sequence[Parameter], tank: TankConfig, recording: RecordingConfig
    ) -> None:
        """Build the box.

        Raises:
            ConfigurationError: If the box contains invalid values, or excludes the initial values.
        """
        self.parameters = tuple(parameters)
        self._fixed = {**tank.model_dump(), "recording": recording.model_dump()}
        for parameter in self.parameters:
            value = self._present(parameter)
            name = parameter.name
            if not parameter.low <= value <= parameter.high:
                path = name if name.startswith("recording.") else f"tank.{name}"
                raise ConfigurationError(
                    f"parameters.{name} = [{parameter.low:g}, {parameter.high:g}]: the initial "
                    f"value {path} = {value:g} is outside this range; widen the range or change "
                    f"{path}"
                )
            # Validate the ends now, not in the middle of a long search.
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
        """Return a function that simulates points on the segments, `batch` at a time."""

        def errors(
            points: Sequence[CalibrationPoint],
        ) -> Iterator[Float[np.ndarray, "segments compared channels"]]:
            for start in range(0, len(points), batch):
                some = [self.configs(point) for point in points[start : start + batch]]
                # Pad to a fixed size so that one compiled program runs all calls.
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
