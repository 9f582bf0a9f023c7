"""Many tanks over many segments in one compiled program: points of a search in, readings and residuals out.

R2 of a channel is pooled: 1 - (sum of squared errors) / (sum of squared deviations from the mean), both sums and the
mean over all compared ticks of all segments together.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant, roll
from softfin.core.quantities import Command
from softfin.tank import Tank, TankConfig
from softfin.tank.calibration.config import Parameter, Point, RecordingConfig
from softfin.tank.calibration.segments import Segments
from softfin.tank.sampling import arrays_of

Errors = Callable[[Sequence[Point]], Iterator[Float[np.ndarray, "segments compared channels"]]]
"""Function from points to the errors of each, divided by each channel's standard deviation."""

QUIET = {
    "sensor": {"noise_n": 0.0, "drift_n": 0.0, "resolution_n": 0.0},
    "drive": {"encoder_step_rad": 0.0},
}
"""A tank without what is random or stepped in the readings: neither can be fitted."""


class Model(NamedTuple):
    """A tank, and by the names of `RecordingConfig` what lies between it and the logs."""

    tank: Plant
    recording: dict[str, Float[Array, "*models"]]

    @classmethod
    def build(cls, tank: TankConfig, recording: RecordingConfig) -> "Model":
        """Return the model of a quiet tank."""
        arrays = dict(zip(RecordingConfig.model_fields, arrays_of(recording), strict=True))
        return cls(Tank(tank.merged(QUIET, "calibration")), arrays)

    def read(self, command: Command) -> Float[Array, "ticks channels"]:
        """Return what the log of this tank would have, from rest, after each command ``(ticks,)`` of a log."""
        by = self.recording
        angle = by["angle_gain"] * command.angle + by["angle_offset_rad"]
        velocity = jnp.minimum(by["velocity_factor"] * command.velocity, by["velocity_limit_rad_s"])
        # No noise is drawn that counts: the key does not matter.
        _, reading = roll(self.tank, self.tank.init(jax.random.key(0)), Command(angle, velocity))
        angle = by["reading_gain"] * reading.angle + by["reading_offset_rad"]
        force = reading.force + jnp.stack([by["force_x_n"], by["force_y_n"]])
        return jnp.concatenate([angle[:, None], force], axis=1)


def stacked(configs: Sequence[tuple[TankConfig, RecordingConfig]]) -> Model:
    """Return the models side by side, along a new first axis of each array."""
    side_by_side: Model = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(Model.build(*each) for each in configs))
    return side_by_side


@eqx.filter_jit
def read(models: Model, command: Command) -> Float[Array, "models segments ticks channels"]:
    """Return what each of the stacked models reads under each segment's commands."""
    readings: Array = jax.vmap(lambda each: jax.vmap(each.read)(command))(models)
    return readings


@eqx.filter_jit
def _errors(models: Model, segments: Segments) -> Float[Array, "models segments compared channels"]:
    """Model less measured behind the warm-up, over each channel's standard deviation: its mean square is 1 - R2."""
    found: Array = (read(models, segments.command)[:, :, segments.warm_up :] - segments.compared) / segments.deviation
    return found


class Space:
    """The box that the free parameters span, round a tank and a recording that give all other numbers."""

    def __init__(self, parameters: Sequence[Parameter], tank: TankConfig, recording: RecordingConfig) -> None:
        """Raise ConfigurationError where the box reaches beyond what is valid, or leaves out its starting point."""
        self.parameters = tuple(parameters)
        self._fixed = {**tank.model_dump(), "recording": recording.model_dump()}
        for parameter in self.parameters:
            value, name = self._present(parameter), parameter.name
            if not parameter.low <= value <= parameter.high:
                path = name if name.startswith("recording.") else f"tank.{name}"
                raise ConfigurationError(
                    f"parameters.{name} = [{parameter.low:g}, {parameter.high:g}]: the search starts at {path} = "
                    f"{value:g}, which is outside; widen the range, or set {path}"
                )
            for end in (parameter.low, parameter.high):
                self._built({name: end}, f"parameters.{name}")
        self.start = np.array([parameter.scaled(self._present(parameter)) for parameter in self.parameters])

    def configs(self, point: Point) -> tuple[TankConfig, RecordingConfig]:
        """Return the tank and the recording at a point."""
        values = {p.name: p.value(float(at)) for p, at in zip(self.parameters, point, strict=True)}
        return self._built(values, "calibration")

    def errors(self, segments: Segments, batch: int) -> Errors:
        """Return the function that simulates points against segments, `batch` at once."""

        def errors(points: Sequence[Point]) -> Iterator[Float[np.ndarray, "segments compared channels"]]:
            for start in range(0, len(points), batch):
                some = [self.configs(point) for point in points[start : start + batch]]
                # Filled up, so that one compiled program serves all calls.
                models = stacked([*some, *some[-1:] * (batch - len(some))])
                yield from np.asarray(_errors(models, segments))[: len(some)]

        return errors

    def _present(self, parameter: Parameter) -> float:
        group, field = parameter.name.split(".")
        return float(self._fixed[group][field])

    def _built(self, values: Mapping[str, float], source: str) -> tuple[TankConfig, RecordingConfig]:
        trees = copy.deepcopy(self._fixed)
        for name, value in values.items():
            group, field = name.split(".")
            trees[group][field] = value
        recording = RecordingConfig.build(trees.pop("recording"), source)
        return TankConfig.build(trees, source), recording
