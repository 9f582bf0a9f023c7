"""The calibration: logs and a configuration in; out come the tank, the recording and how well both are determined.

A global search with a coarse tank finds the valley, a local one with the whole tank its bottom, and the slopes there
say what the logs determine.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import RATE_HZ, Command, Log
from softfin.storage.run_directory import RunDirectory
from softfin.tank import TankConfig
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.determination import Determination, determination, parameters_to_dict
from softfin.tank.calibration.model import Fitting, model, read, stacked
from softfin.tank.calibration.parameters import Point, Space, parameters_of
from softfin.tank.calibration.pieces import CHANNELS, Pieces, cut
from softfin.tank.calibration.polish import Linear, polish, weights_of
from softfin.tank.calibration.recording import RecordingConfig
from softfin.tank.calibration.search import search

Progress = Callable[[str, float, str], None]
"""What is going on, how much of it is done (0 .. 1), the newest figures."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What was found."""

    tank: TankConfig
    recording: RecordingConfig
    space: Space
    linear: Linear
    determination: Determination
    train: Pieces
    test: Pieces

    def read(self, command: Command) -> Float[np.ndarray, "pieces ticks channels"]:
        """What the log of the found tank would have under commands ``(pieces, ticks)`` of a log."""
        return np.asarray(read(stacked([model(self.tank, self.recording)]), command)[0])

    def summary(self) -> dict[str, Any]:
        """Scores on both parts, parameters and their determination, the recording."""
        return {
            "scores": {part: scores(self.read(pieces.command), pieces) for part, pieces in self._parts().items()},
            **parameters_to_dict(self.determination, self.linear, self.space.parameters),
            "recording": self.recording.model_dump(),
        }

    def _parts(self) -> dict[str, Pieces]:
        return {"train": self.train, "test": self.test}


def prepared(config: CalibrateConfig, train: Sequence[Log], test: Sequence[Log]) -> tuple[Space, Pieces, Pieces]:
    """What is searched, what it is fitted to and what it is judged on; raises where either is not usable."""
    parameters = list(parameters_of(config.parameters))
    if not parameters:
        raise ConfigurationError("parameters: all are null; give at least one a range, such as fin.span_m: [0.03, 0.2]")
    space = Space(parameters, config.tank, config.recording)
    rows, warm_up = round(config.piece_s * RATE_HZ), round(config.warm_up_s * RATE_HZ)
    fitted = cut(train, config.pieces, rows, warm_up, "training")
    blocks = len(fitted.measured) * ((rows - warm_up) // round(config.block_s * RATE_HZ))
    if blocks < 2 * len(parameters):
        raise LogError(
            f"training logs: {len(fitted.measured)} pieces make {blocks} blocks of {config.block_s:g} s, which cannot "
            f"tell {len(parameters)} parameters; record more, raise `pieces` or `piece_s`, or fit fewer parameters"
        )
    return space, fitted, cut(test, config.test_pieces, rows, warm_up, "test")


def calibrate(
    config: CalibrateConfig,
    train: Sequence[Log],
    test: Sequence[Log],
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a tank to the training logs; goes on from its checkpoint where there is one.

    Raises:
        ConfigurationError: a parameter that does not exist, or a range without its starting point.
        LogError: logs too short for one piece, or too few for so many parameters.
        RunError: no tank has finite readings.
    """
    space, fitted, unseen = prepared(config, train, test)
    weights = weights_of([getattr(config.weights, channel) for channel in CHANNELS])
    point = _global(config, space, fitted, weights, seed, run_directory, progress)
    whole = Fitting(space, fitted, config.population)

    def report(iteration: int, loss: float) -> None:
        if progress is not None:
            progress("polish", iteration / config.iterations, f"1 - R2 {loss:.4f}")

    linear = polish(whole, point, weights, config.iterations, report)
    if progress is not None:
        progress("polish", 1.0, f"1 - R2 {linear.loss:.4f}")
    found = determination(linear, round(config.block_s * RATE_HZ))
    tank, recording = space.configs(linear.point)
    return Calibration(tank, recording, space, linear, found, fitted, unseen)


def scores(modelled: Float[np.ndarray, "pieces ticks channels"], pieces: Pieces) -> dict[str, dict[str, float]]:
    """Return for each channel the pooled R2, RMSE, and mean and standard deviation of what is measured and modelled."""
    measured = np.asarray(pieces.compared, np.float64)
    ours = np.asarray(modelled[:, pieces.warm_up :], np.float64)
    rows = {}
    for index, channel in enumerate(CHANNELS):
        true, predicted = measured[..., index], ours[..., index]
        square = float(np.mean((predicted - true) ** 2))
        rows[channel] = {
            "r2": 1 - square / float(np.var(true)),
            "rmse": float(np.sqrt(square)),
            "mean_measured": float(true.mean()),
            "mean_modelled": float(predicted.mean()),
            "std_measured": float(true.std()),
            "std_modelled": float(predicted.std()),
        }
    return rows


def _global(
    config: CalibrateConfig,
    space: Space,
    pieces: Pieces,
    weights: Float[np.ndarray, "channels"],
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None,
) -> Point:
    generations = -(-config.evaluations // config.population)
    if generations == 0:
        run_directory.log().close()
        return space.start
    coarse = Fitting(space, pieces, config.population, (config.search_plates, config.search_steps))
    losses, done = np.full((generations, config.population), np.nan, np.float32), 0
    if (resumed := run_directory.load(jnp.asarray(losses))) is not None:
        losses, done = np.asarray(resumed[0]), resumed[1]["generation"]
    record = run_directory.log(rewind_to=done)

    def report(generation: int, losses: Float[np.ndarray, "generations population"]) -> None:
        least = float(np.nanmin(losses))
        record.write(generation, loss=float(losses[generation - 1].min()), best=least)
        run_directory.save(jnp.asarray(losses), {"generation": generation})
        if progress is not None:
            progress("search", generation / generations, f"1 - R2 {least:.4f}")

    def loss(points: Sequence[Point]) -> Float[np.ndarray, "population"]:
        return np.asarray(coarse.misfits(points) @ weights, np.float32)

    point, _ = search(loss, space.start, config.step, losses, seed, report)
    record.close()
    return point
