"""Calibrates a tank from logs: the result is the tank, the recording, and a measure of how well
their parameters are determined.

A global search with a coarse tank finds the region of the optimum, and a local search with the full
tank refines it. The Jacobian at the optimum shows which parameters the logs determine.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Float

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ, Command, Log
from softfin.storage import artifact as artifacts
from softfin.storage.run_directory import RunDirectory
from softfin.tank import TankConfig
from softfin.tank.calibration.config import (
    BLOCK_S,
    CalibrateConfig,
    CalibrationPoint,
    RecordingConfig,
    list_parameters,
)
from softfin.tank.calibration.model import FITTED_CHANNELS, Segments, Space, cut, read, stacked
from softfin.tank.calibration.search import Losses, determination, misfits, polish, search

ChannelScores: TypeAlias = dict[str, dict[str, float]]
"""``r2`` and ``rmse`` by channel."""

POPULATION = 16
"""Number of tanks per generation of the global search, which are simulated together."""

SEARCH_TANK = {"fin": {"plates": 4}, "steps_per_tick": 1}
"""Resolution of the tanks in the global search; the local search uses that of the initial tank."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The fitted tank and recording, and the training and test segments."""

    tank: TankConfig
    recording: RecordingConfig
    determination: JsonObject
    train: Segments
    test: Segments

    def read(self, command: Command) -> Float[np.ndarray, "segments ticks channels"]:
        """Simulate the readings that a log of the fitted tank would contain.

        The fields of `command` are commands of a log, ``(segments, ticks)``.
        """
        return np.asarray(read(stacked([(self.tank, self.recording)]), command)[0])

    def write(
        self,
        out: Path,
        metadata: JsonObject,
        extra_files: Callable[[Path], None],
        overwrite: bool,
    ) -> JsonObject:
        """Write the folder, completely or not at all, and return the content of its
        ``calibration.json`` (see docs/files.md)."""
        summary = {
            **artifacts.head("calibration"),
            "scores": {
                "train": scores(self.read(self.train.command), self.train),
                "test": scores(self.read(self.test.command), self.test),
            },
            **self.determination,
            "recording": self.recording.model_dump(),
            **metadata,
        }

        def write(folder: Path) -> None:
            artifacts.write_description(folder, "calibration", summary)
            _write_yaml(folder / "tank.yaml", self.tank, "The fitted tank.")
            head = "How the logs differ from the readings of that tank."
            _write_yaml(folder / "recording.yaml", self.recording, head)
            extra_files(folder)

        artifacts.write_folder(out, write, overwrite)
        return summary


def _write_yaml(file: Path, config: Configuration, head: str) -> None:
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
    file.write_text(f"# {head}\n{text}")


def prepared(
    config: CalibrateConfig, train: Sequence[Log], test: Sequence[Log]
) -> tuple[Space, Segments, Segments]:
    """Return the search space, the training segments and the test segments.

    Raises:
        ConfigurationError: no parameter is free, or a range is invalid.
        LogError: the logs are too short to determine the parameters.
    """
    parameters = list_parameters(config.parameters)
    if not parameters:
        raise ConfigurationError(
            "parameters: all are null; set a range for at least one, e.g. "
            "fin: {span_m: [0.03, 0.2]}"
        )
    space = Space(parameters, config.tank, config.recording)
    rows = round(config.segment_s * RATE_HZ)
    warm_up = round(config.warm_up_s * RATE_HZ)
    fitted = cut(train, config.segments, rows, warm_up, "training")
    count = len(fitted.measured)
    blocks = count * ((rows - warm_up) // round(BLOCK_S * RATE_HZ))
    # The jackknife needs several blocks per parameter for its standard errors.
    if blocks < 2 * len(parameters):
        raise LogError(
            f"training logs: {count} segments contain {blocks} blocks of {BLOCK_S:g} s; "
            f"{len(parameters)} parameters need at least {2 * len(parameters)}; record more, raise "
            "`segments` or `segment_s`, or fit fewer parameters"
        )
    return space, fitted, cut(test, config.test_segments, rows, warm_up, "test")


def calibrate_tank(
    config: CalibrateConfig,
    train: Sequence[Log],
    test: Sequence[Log],
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a tank to the training logs; resume from the checkpoint in `run_directory`, if any."""
    tell = progress or silent
    space, fitted, unseen = prepared(config, train, test)
    coarse = config.tank.merged(SEARCH_TANK, "calibration")
    rough = Space(space.parameters, coarse, config.recording)
    errors = rough.errors(fitted, POPULATION)
    generations = -(-config.evaluations // POPULATION)
    done = 0
    # NaN marks tanks that have not been simulated yet.
    losses = np.full((generations, POPULATION), np.nan, np.float32)
    if (resumed := run_directory.load(jnp.asarray(losses))) is not None:
        losses = np.asarray(resumed[0])
        done = resumed[1]["generation"]
    record = run_directory.log(rewind_to=done)

    def loss(points: Sequence[CalibrationPoint]) -> Float[np.ndarray, "population"]:
        return np.asarray(misfits(errors, points).mean(axis=1), np.float32)

    def searched(generation: int, losses: Losses) -> None:
        # The checkpoint contains only losses: `search` recomputes the state of CMA-ES from them.
        least = float(np.nanmin(losses))
        record.write(generation, loss=float(losses[generation - 1].min()), best=least)
        run_directory.save(jnp.asarray(losses), {"generation": generation})
        tell("search", generation / generations, f"1 - R2 {least:.4f}")

    point = search(loss, space.start, config.step, losses, seed, searched)

    def polished(iteration: int, loss: float) -> None:
        tell("polish", iteration / config.iterations, f"1 - R2 {loss:.4f}")

    linear = polish(space.errors(fitted, POPULATION), point, config.iterations, polished)
    polished(config.iterations, linear.loss)
    found = determination(linear, round(BLOCK_S * RATE_HZ), space.parameters)
    return Calibration(*space.configs(linear.point), found, fitted, unseen)


def scores(
    modelled: Float[np.ndarray, "segments ticks channels"], segments: Segments
) -> ChannelScores:
    """Return R2 and RMSE of each channel, pooled over all segments."""
    rows = {}
    for index, channel in enumerate(FITTED_CHANNELS):
        true = np.asarray(segments.compared, np.float64)[..., index]
        predicted = np.asarray(modelled, np.float64)[:, segments.warm_up :, index]
        square = float(np.mean((predicted - true) ** 2))
        # R2 = 1 - mean square error / variance of the measurement.
        rows[channel] = {
            "r2": 1 - square / float(np.var(true)),
            "rmse": float(np.sqrt(square)),
        }
    return rows
