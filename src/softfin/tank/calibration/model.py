"""Many tanks over many pieces in one compiled program: readings, residuals and coefficients of determination.

R2 of a channel is pooled: 1 - (sum of squared errors) / (sum of squared deviations from the mean), both sums and the
mean over all compared ticks of all pieces together.
"""

from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.tank import Tank, TankConfig
from softfin.tank.calibration.parameters import Point, Space
from softfin.tank.calibration.pieces import Pieces
from softfin.tank.calibration.recording import Recording, RecordingConfig


class Model(eqx.Module):
    """A tank, and what lies between it and the logs."""

    tank: Tank
    recording: Recording

    def read(self, command: Command) -> Float[Array, "ticks channels"]:
        """What the log of this tank would have, from rest, after each command ``(ticks,)`` of a log."""
        # No noise is drawn that counts: the key does not matter.
        _, reading = roll(self.tank, self.tank.init(jax.random.key(0)), self.recording.issued(command))
        reading = self.recording.written(reading)
        return jnp.concatenate([reading.angle[:, None], reading.force], axis=1)


def model(tank: TankConfig, recording: RecordingConfig) -> Model:
    """Without what is random or stepped in the readings: neither can be fitted."""
    quiet = tank.merged(
        {
            "sensor": {"noise_n": 0.0, "drift_n": 0.0, "resolution_n": 0.0},
            "drive": {"encoder_step_rad": 0.0},
        },
        "calibration",
    )
    return Model(Tank(quiet), Recording.build(recording))


def stacked(models: Sequence[Model]) -> Model:
    """Side by side, along a new first axis of each array."""
    both: Model = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    return both


@eqx.filter_jit
def read(models: Model, command: Command) -> Float[Array, "models pieces ticks channels"]:
    """What each of the stacked models reads under each piece's commands."""
    readings: Array = jax.vmap(lambda each: jax.vmap(each.read)(command))(models)
    return readings


@eqx.filter_jit
def errors(models: Model, pieces: Pieces) -> Float[Array, "models pieces compared channels"]:
    """Model less measured behind the warm-up, over each channel's standard deviation: its mean square is 1 - R2."""
    found: Array = (read(models, pieces.command)[:, :, pieces.warm_up :] - pieces.compared) / pieces.deviation
    return found


class Fitting:
    """What a search calls: points of a space in, errors against pieces out, a fixed number of tanks at once."""

    def __init__(self, space: Space, pieces: Pieces, batch: int, resolution: tuple[int, int] | None = None) -> None:
        """`resolution`: plates and steps a tick; by default those of the space's tank."""
        self.space = space
        self.pieces = pieces
        self.batch = batch
        self.resolution = resolution

    def errors(self, points: Sequence[Point]) -> Iterator[Float[np.ndarray, "pieces compared channels"]]:
        """Yield the errors of each point; see `errors`."""
        for start in range(0, len(points), self.batch):
            some = points[start : start + self.batch]
            each = errors(self._stacked(some), self.pieces)
            yield from np.asarray(each)[: len(some)]

    def misfits(self, points: Sequence[Point]) -> Float[np.ndarray, "points channels"]:
        """1 - R2 of each point and channel; not finite where a tank's readings are not."""
        return np.stack([np.mean(np.square(each, dtype=np.float64), axis=(0, 1)) for each in self.errors(points)])

    def _stacked(self, points: Sequence[Point]) -> Model:
        models = [self._model(point) for point in points]
        # Filled up, so that one compiled program serves all calls.
        return stacked([*models, *models[-1:] * (self.batch - len(models))])

    def _model(self, point: Point) -> Model:
        tank, recording = self.space.configs(point)
        if self.resolution is not None:
            plates, steps = self.resolution
            tank = tank.merged({"fin": {"plates": plates}, "steps_per_tick": steps}, "calibration")
        return model(tank, recording)
