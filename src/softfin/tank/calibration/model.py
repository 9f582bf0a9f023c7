"""Many tanks over many segments in one compiled program: points of a search in, readings and residuals out.

R2 of a channel is pooled: 1 - (sum of squared errors) / (sum of squared deviations from the mean), both sums and the
mean over all compared ticks of all segments together.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.errors import ConfigurationError
from softfin.core.plant import roll
from softfin.core.quantities import Command, Reading
from softfin.tank import Tank, TankConfig
from softfin.tank.calibration.config import Parameter, Point, RecordingConfig
from softfin.tank.calibration.segments import Segments
from softfin.tank.sampling import arrays_of

Errors = Callable[[Sequence[Point]], Iterator[Float[np.ndarray, "segments compared channels"]]]
"""Function from points to the errors of each, divided by each channel's standard deviation."""


class RecordingArrays(NamedTuple):
    """A recording's configuration as arrays, so that recordings can be stacked beside tanks."""

    angle_gain: Float[Array, "*models"]
    angle_offset: Float[Array, "*models"]
    velocity_factor: Float[Array, "*models"]
    velocity_limit: Float[Array, "*models"]
    reading_gain: Float[Array, "*models"]
    reading_offset: Float[Array, "*models"]
    force_x: Float[Array, "*models"]
    force_y: Float[Array, "*models"]

    @classmethod
    def build(cls, config: RecordingConfig) -> "RecordingArrays":
        """Return the arrays of a configuration, whose fields are in the same order."""
        return cls(*arrays_of(config))

    def issued(self, command: Command) -> Command:
        """Return what a tank must be commanded where the log has `command`."""
        angle = self.angle_gain * command.angle + self.angle_offset
        return Command(angle, jnp.minimum(self.velocity_factor * command.velocity, self.velocity_limit))

    def written(self, reading: Reading) -> Reading:
        """Return what the log has where a tank reads `reading`."""
        return reading._replace(
            angle=self.reading_gain * reading.angle + self.reading_offset,
            velocity=self.reading_gain * reading.velocity,
            force=reading.force + jnp.stack([self.force_x, self.force_y]),
        )


class Model(eqx.Module):
    """A tank, and what lies between it and the logs."""

    tank: Tank
    recording: RecordingArrays

    def read(self, command: Command) -> Float[Array, "ticks channels"]:
        """Return what the log of this tank would have, from rest, after each command ``(ticks,)`` of a log."""
        # No noise is drawn that counts: the key does not matter.
        _, reading = roll(self.tank, self.tank.init(jax.random.key(0)), self.recording.issued(command))
        reading = self.recording.written(reading)
        return jnp.concatenate([reading.angle[:, None], reading.force], axis=1)


def stacked(configs: Sequence[tuple[TankConfig, RecordingConfig]]) -> Model:
    """Return the models side by side, along a new first axis of each array.

    They are without what is random or stepped in the readings: neither can be fitted.
    """
    quiet = {
        "sensor": {"noise_n": 0.0, "drift_n": 0.0, "resolution_n": 0.0},
        "drive": {"encoder_step_rad": 0.0},
    }
    models = [
        Model(Tank(tank.merged(quiet, "calibration")), RecordingArrays.build(recording)) for tank, recording in configs
    ]
    side_by_side: Model = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
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
        self.tank = tank
        self.recording = recording
        self.start = np.array([parameter.scaled(self._present(parameter)) for parameter in self.parameters])
        for parameter in self.parameters:
            for end in (parameter.low, parameter.high):
                self._built({parameter.name: end}, f"parameters.{parameter.name}")

    def configs(self, point: Point) -> tuple[TankConfig, RecordingConfig]:
        """Return the tank and the recording at a point."""
        values = {p.name: p.value(float(at)) for p, at in zip(self.parameters, point, strict=True)}
        return self._built(values, "calibration")

    def errors(self, segments: Segments, batch: int, resolution: tuple[int, int] | None = None) -> Errors:
        """Return the function that simulates points against segments, `batch` at once.

        `resolution`: plates and steps a tick; by default those of the space's tank.
        """

        def config(point: Point) -> tuple[TankConfig, RecordingConfig]:
            tank, recording = self.configs(point)
            if resolution is not None:
                plates, steps = resolution
                tank = tank.merged({"fin": {"plates": plates}, "steps_per_tick": steps}, "calibration")
            return tank, recording

        def errors(points: Sequence[Point]) -> Iterator[Float[np.ndarray, "segments compared channels"]]:
            for start in range(0, len(points), batch):
                some = [config(point) for point in points[start : start + batch]]
                # Filled up, so that one compiled program serves all calls.
                models = stacked([*some, *some[-1:] * (batch - len(some))])
                yield from np.asarray(_errors(models, segments))[: len(some)]

        return errors

    def _built(self, values: Mapping[str, float], source: str) -> tuple[TankConfig, RecordingConfig]:
        trees = {**self.tank.model_dump(), "recording": self.recording.model_dump()}
        for name, value in values.items():
            group, field = name.split(".")
            trees[group][field] = value
        recording = RecordingConfig.build(trees.pop("recording"), source)
        return TankConfig.build(trees, source), recording

    def _present(self, parameter: Parameter) -> float:
        group, field = parameter.name.split(".")
        owner = self.recording if group == "recording" else getattr(self.tank, group)
        value = float(getattr(owner, field))
        if not parameter.low <= value <= parameter.high:
            path = parameter.name if group == "recording" else f"tank.{parameter.name}"
            raise ConfigurationError(
                f"parameters.{parameter.name} = [{parameter.low:g}, {parameter.high:g}]: the search starts at {path} = "
                f"{value:g}, which is outside; widen the range, or set {path}"
            )
        return value
