"""The calibration: logs and a configuration in; out come the tank, the recording and how well both are determined.

A global search with a coarse tank finds the valley, a local one with the whole tank its bottom, and the slopes there
show what the logs determine.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Float

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, Command, Log
from softfin.storage import artifact as artifacts
from softfin.storage.figures import save_figure
from softfin.storage.run_directory import RunDirectory
from softfin.tank import TankConfig
from softfin.tank.calibration.config import CalibrateConfig, Point, RecordingConfig, parameters_of
from softfin.tank.calibration.determination import determination
from softfin.tank.calibration.figure import Scores, calibration_figure
from softfin.tank.calibration.model import Space, read, stacked
from softfin.tank.calibration.search import Losses, Weights, misfits, polish, search
from softfin.tank.calibration.segments import CHANNELS, Segments, cut


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The tank and the recording that were found, and the segments that they were fitted to and judged on."""

    tank: TankConfig
    recording: RecordingConfig
    determination: dict[str, Any]
    train: Segments
    test: Segments

    def read(self, command: Command) -> Float[np.ndarray, "segments ticks channels"]:
        """Return what the log of the found tank would have under commands ``(segments, ticks)`` of a log."""
        return np.asarray(read(stacked([(self.tank, self.recording)]), command)[0])

    def write(
        self, out: Path, metadata: dict[str, Any], extra_files: Callable[[Path], None], overwrite: bool
    ) -> dict[str, Any]:
        """Write the folder, whole or not at all; returns the content of its ``calibration.json``.

        ============== ============================================================================================
        ``scores``     of ``train`` and ``test`` by channel: pooled ``r2``, ``rmse``, means and standard deviations of
                       what is measured and modelled [rad, N, N]
        ``parameters`` by name: ``value``, ``unit``, ``range``; ``standard_error``, 95% ``interval``, ``left``: the
                       standard error over the deviation of the whole range; ``determined``: well, roughly, poorly;
                       or low end, high end of the range, no effect
        ``trades``     pairs of parameters whose errors are correlated by more than 0.9
        ``recording``  what lies between tank and logs
        ============== ============================================================================================
        """
        modelled = self.read(self.test.command)
        judged = scores(modelled, self.test)
        summary = {
            "scores": {"train": scores(self.read(self.train.command), self.train), "test": judged},
            **self.determination,
            "recording": self.recording.model_dump(),
            **metadata,
        }

        def write(folder: Path) -> None:
            (folder / "calibration.json").write_text(artifacts.dump_json(summary))
            for name, config, head in (
                ("tank", self.tank, "The tank that was found."),
                ("recording", self.recording, "How the logs differ from what that tank reads."),
            ):
                text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
                (folder / f"{name}.yaml").write_text(f"# {head}\n{text}")
            save_figure(calibration_figure(self.test, modelled, judged), folder, "calibration")
            extra_files(folder)

        artifacts.write_folder(out, write, overwrite)
        return summary


def prepared(config: CalibrateConfig, train: Sequence[Log], test: Sequence[Log]) -> tuple[Space, Segments, Segments]:
    """Return what is searched, what it is fitted to and what it is judged on; raises where either is not usable."""
    parameters = parameters_of(config.parameters)
    if not parameters:
        raise ConfigurationError("parameters: all are null; give at least one a range, such as fin.span_m: [0.03, 0.2]")
    space = Space(parameters, config.tank, config.recording)
    rows, warm_up = round(config.segment_s * RATE_HZ), round(config.warm_up_s * RATE_HZ)
    fitted = cut(train, config.segments, rows, warm_up, "training")
    count = len(fitted.measured)
    blocks = count * ((rows - warm_up) // round(config.block_s * RATE_HZ))
    if blocks < 2 * len(parameters):
        raise LogError(
            f"training logs: {count} segments make {blocks} blocks of {config.block_s:g} s, which cannot determine "
            f"{len(parameters)} parameters; record more, raise `segments` or `segment_s`, or fit fewer parameters"
        )
    return space, fitted, cut(test, config.test_segments, rows, warm_up, "test")


def calibrate(
    config: CalibrateConfig,
    train: Sequence[Log],
    test: Sequence[Log],
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a tank to the training logs; goes on from the run directory's checkpoint where there is one.

    Raises:
        ConfigurationError: a parameter that does not exist, or a range without its starting point.
        LogError: logs too short for one segment, or too few for so many parameters.
        RunError: no tank has finite readings.
    """
    tell = progress or (lambda stage, fraction, note: None)
    space, fitted, unseen = prepared(config, train, test)
    weights = normalised([getattr(config.weights, channel) for channel in CHANNELS])
    point = _global(config, space, fitted, weights, seed, run_directory, tell)

    def report(iteration: int, loss: float) -> None:
        tell("polish", iteration / config.iterations, f"1 - R2 {loss:.4f}")

    linear = polish(space.errors(fitted, config.population), point, weights, config.iterations, report)
    report(config.iterations, linear.loss)
    found = determination(linear, round(config.block_s * RATE_HZ), space.parameters)
    return Calibration(*space.configs(linear.point), found, fitted, unseen)


def normalised(weights: Sequence[float]) -> Weights:
    """Return the weights divided by their sum."""
    return np.asarray(np.asarray(weights) / np.sum(weights))


def scores(modelled: Float[np.ndarray, "segments ticks channels"], segments: Segments) -> Scores:
    """Return for each channel the pooled R2, RMSE, and mean and standard deviation of what is measured and modelled."""
    rows = {}
    for index, channel in enumerate(CHANNELS):
        true = np.asarray(segments.compared, np.float64)[..., index]
        predicted = np.asarray(modelled, np.float64)[:, segments.warm_up :, index]
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
    segments: Segments,
    weights: Weights,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress,
) -> Point:
    generations = -(-config.evaluations // config.population)
    if generations == 0:
        run_directory.log().close()
        return space.start
    plates, steps = config.search_plates, config.search_steps
    coarse = config.tank.merged({"fin": {"plates": plates}, "steps_per_tick": steps}, "calibration")
    errors = Space(space.parameters, coarse, config.recording).errors(segments, config.population)
    losses, done = np.full((generations, config.population), np.nan, np.float32), 0
    if (resumed := run_directory.load(jnp.asarray(losses))) is not None:
        losses, done = np.asarray(resumed[0]), resumed[1]["generation"]
    record = run_directory.log(rewind_to=done)

    def loss(points: Sequence[Point]) -> Float[np.ndarray, "population"]:
        return np.asarray(misfits(errors, points) @ weights, np.float32)

    def report(generation: int, losses: Losses) -> None:
        least = float(np.nanmin(losses))
        record.write(generation, loss=float(losses[generation - 1].min()), best=least)
        run_directory.save(jnp.asarray(losses), {"generation": generation})
        progress("search", generation / generations, f"1 - R2 {least:.4f}")

    point = search(loss, space.start, config.step, losses, seed, report)
    record.close()
    return point
