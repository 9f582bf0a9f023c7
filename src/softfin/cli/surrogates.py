"""Commands for models of a fin: ``fit`` and ``calibrate``."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Configured, Data, LogOptions, Logs, Out, numbers
from softfin.cli.options import Option
from softfin.cli.output import progress
from softfin.core.choices import CalibratePreset
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.data.issues import counted
from softfin.surrogate.registry import DEFAULT, PAPER, find_architecture

VELOCITY_RANGE = Option(
    "LOW,HIGH", parse=numbers("not a range; use LOW,HIGH in rad/s, e.g. 0.3,1.57", count=2)
)


class FitArguments(LogOptions, Configured):
    """Fit a surrogate to logs and print its scores (paper Sec. III-B, Table I)."""

    dataset: Logs
    """Folder of a dataset, or of CSV files, Parquet files or ROS 2 bags."""
    out: Out
    """Surrogate folder to write."""
    model: str = DEFAULT
    """streaming: an ensemble of recurrent networks; paper: PosNet and ForceNet; or
    package.module:ARCHITECTURE."""
    ignore_errors: bool = False
    """Also fit to logs with errors."""
    epochs: int | None = None
    """Maximum number of epochs, with --model paper."""
    seed: int = 0
    """Seed for weights, shuffling and dropout."""
    resume: bool = False
    """Continue from the last checkpoint of an unfinished run."""

    def check(self) -> None:
        """Reject options that do not apply to the model."""
        if self.epochs is not None and self.model != PAPER:
            raise ConfigurationError(
                f"--epochs: applies only to --model paper, got --model {self.model}; use "
                "--set force_updates=N instead"
            )
        super().check()

    def __call__(self) -> None:
        # Before the imports below, which take seconds, because the name may be unknown.
        config = self.configured(find_architecture(self.model).config())
        from softfin.core.action_clock import ActionClock
        from softfin.stages.surrogates import fit
        from softfin.stages.tables import format_table_one

        with progress() as report:
            result = fit(
                self.dataset,
                self.out,
                config,
                logs=self.recordings,
                ignore_errors=self.ignore_errors,
                seed=self.seed,
                resume=self.resume,
                overwrite=self.overwrite,
                progress=report,
            )
        notes = self.columns_read(result["columns"]) + warning(result["issues"], self.dataset)
        if result["warning"] is not None:
            notes += f"warning: {result['warning']}\n"
        sys.stderr.write(printable(notes, "\n"))
        parts = [format_table_one(result["table_i"])]
        if (stroke_s := result["stroke_s"]) is not None:
            parts.append(
                f"stroke time {stroke_s:.2g} s: softfin train --clock auto would use "
                f"{ActionClock.for_strokes(stroke_s)}"
            )
        if result["caveat"] is not None:
            parts.append(f"note: {result['caveat']}")
        self.tell({"surrogate": str(self.out), **result}, "\n\n".join(parts))


def warning(counts: Mapping[str, int], dataset: Path) -> str:
    """Return one line with the issue counts of the training logs; empty if there are no issues."""
    if not counts["error"] + counts["warning"]:
        return ""
    found = ", ".join(counted(count, kind) for kind, count in counts.items() if count)
    return f"{dataset}: {found}; run softfin inspect {dataset} to list them\n"


class CalibrateArguments(Configured):
    """Fit the virtual tank to logs or to a plant, and report how well each parameter is
    determined."""

    data: Data
    """Dataset folder, or a plant: tank, a tank's YAML file, a surrogate's folder, or
    package.module:plant."""
    out: Out
    """Output folder for calibration.json, tank.yaml and the figures."""
    preset: CalibratePreset = "full"
    """full: fit the parameters of fin, water, drive and recording; quick: fit six parameters, in
    about a minute."""
    evaluations: int | None = None
    """Number of tanks evaluated by the global search; 0 for local search only (default: 4000)."""
    velocity: Annotated[tuple[float, ...], VELOCITY_RANGE] | None = None
    """Range of command velocities for a plant [rad/s] (default: the plant's limits)."""
    seed: int = 0
    """Seed for the search and the commands."""
    resume: bool = False
    """Continue a stopped run."""

    def __call__(self) -> None:
        from softfin.stages.surrogates import calibrate
        from softfin.tank.calibration.config import CALIBRATE_PRESETS

        config = self.configured(CALIBRATE_PRESETS[self.preset], velocity_rad_s=self.velocity)
        with progress() as report:
            result = calibrate(
                self.data,
                self.out,
                config,
                seed=self.seed,
                resume=self.resume,
                overwrite=self.overwrite,
                progress=report,
            )
        self.tell({"calibration": str(self.out), **result}, calibration_tables(result))


def calibration_tables(result: JsonObject) -> str:
    """Return the scores, then the parameters."""
    from softfin.stages.tables import aligned

    scores = [["R2 (RMSE)", "angle", "force x", "force y"]]
    for part, title in (("train", "fitted segments"), ("test", "unseen segments")):
        rows = zip(result["scores"][part].values(), ("rad", "N", "N"), strict=True)
        scores.append(
            [title, *(f"{row['r2']:.3f} ({row['rmse']:.2g} {unit})" for row, unit in rows)]
        )
    parameters = [["parameter", "value", "error", "unit", "determined"]]
    for name, row in result["parameters"].items():
        error = "" if row["standard_error"] is None else f"{row['standard_error']:.2g}"
        parameters.append([name, f"{row['value']:.4g}", error, row["unit"], row["determined"]])
    trades = [
        f"{' and '.join(pair['parameters'])} trade off against each other: correlation "
        f"{pair['correlation']:+.2f}"
        for pair in result["trades"]
    ]
    return "\n".join([*aligned(scores), "", *aligned(parameters, (0, 3)), *trades])
