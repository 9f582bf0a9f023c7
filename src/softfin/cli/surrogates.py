"""Commands for models of a fin: ``fit``, ``import-keras``, ``compare`` and ``calibrate``."""

import sys
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated

from softfin.cli.common import (
    Common,
    Configured,
    Data,
    File,
    LogOptions,
    Logs,
    Out,
    PlantName,
    folder_option,
    numbers,
    progress,
)
from softfin.cli.options import Option
from softfin.core.choices import CalibratePreset
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.data.issues import counted
from softfin.surrogate.registry import DEFAULT, PAPER, find_architecture, list_architectures

VELOCITY_RANGE = Option(
    "LOW,HIGH", parse=numbers("not a range; use LOW,HIGH in rad/s, e.g. 0.3,1.57", count=2)
)
HORIZONS = Option(
    "SECONDS,...",
    parse=numbers("not a list of numbers; use seconds separated by commas, e.g. 1,5,30"),
)


class FitArguments(LogOptions, Configured):
    """Fit a surrogate to logs and print its scores (paper Sec. III-B, Table I)."""

    dataset: Logs
    """Folder of a dataset, or of CSV files, Parquet files or ROS 2 bags."""
    out: Out
    """Surrogate folder to write."""
    model: Annotated[str, Option(choices=list_architectures)] = DEFAULT
    """streaming: an ensemble of recurrent networks; paper: PosNet and ForceNet."""
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
        from softfin.cli.tables import format_table_one
        from softfin.core.action_clock import ActionClock
        from softfin.stages.surrogates import fit

        config = self.configured(find_architecture(self.model).config())
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


class ImportKerasArguments(Common):
    """Convert two Keras 2 networks and their scalers to a surrogate, without TensorFlow or pickle
    files."""

    scalers: File
    """JSON file: {channel: {scale, offset, data_min, data_max}}."""
    posnet: Annotated[Path, Option("POSNET", positional=True)]
    """PosNet's .keras file."""
    forcenet: Annotated[Path, Option("FORCENET", positional=True)]
    """ForceNet's .keras file."""
    out: Out
    """Surrogate folder to write."""

    def __call__(self) -> None:
        from softfin.stages.surrogates import import_keras

        surrogate = import_keras(
            self.posnet, self.forcenet, self.scalers, self.out, overwrite=self.overwrite
        )
        nets = {"posnet": surrogate.posnet, "forcenet": surrogate.forcenet}
        counts = {name: net.config.parameters() for name, net in nets.items()}
        text = (
            f"{self.out}: PosNet {counts['posnet']:,} and ForceNet {counts['forcenet']:,} "
            "parameters"
        )
        self.tell(
            {
                "surrogate": str(self.out),
                "parameters": counts,
                "limits": surrogate.limits.to_dict(),
            },
            text,
        )


class CompareArguments(Configured):
    """Score surrogates on the test logs of a dataset: simulate the recorded commands without
    correction (open loop) over several horizons."""

    surrogates: Annotated[tuple[Path, ...], folder_option("surrogate", positional=True)]
    """Surrogate folders. Surrogates that differ only in the seed are averaged."""
    dataset: Annotated[Path, folder_option("dataset")]
    """Dataset folder with the test logs."""
    out: Out
    """Output folder for comparison.json and the figure."""
    horizons: Annotated[tuple[float, ...], HORIZONS] | None = None
    """Open-loop horizons in seconds (default: 1,5,30)."""
    noise_floor: PlantName | None = None
    """Plant that records the same commands again, such as the recorded tank. Shows the error that
    remains because of noise, drift and perturbed tanks."""
    seed: int | None = None
    """Seed for the noise of that second recording (default: 0)."""

    def __call__(self) -> None:
        from softfin.stages.surrogates import compare
        from softfin.surrogate.compare.compare import CompareConfig

        config = self.configured(CompareConfig(), horizons_s=self.horizons)
        with progress() as report:
            result = compare(
                self.surrogates,
                self.dataset,
                self.out,
                config,
                noise_floor=self.noise_floor,
                overwrite=self.overwrite,
                progress=report,
            )
        self.tell({"comparison": str(self.out), **result}, comparison_tables(result))


# Title, unit, score, and the factor from the score's unit to the unit shown.
ERRORS = (
    ("angle RMSE", "[mrad]", "angle_rmse_rad", 1000),
    ("angle MAE", "[mrad]", "angle_mae_rad", 1000),
    ("force x RMSE", "[N]", "force_x_rmse_n", 1),
    ("force y RMSE", "[N]", "force_y_rmse_n", 1),
    ("force MAE", "[N]", "force_mae_n", 1),
    ("force x R2", "", "force_x_r2", 1),
    ("force y R2", "", "force_y_r2", 1),
)
MEANS = (
    ("MAE x", "[N]", "mean_force_x_mae_n", 1),
    ("MAE y", "[N]", "mean_force_y_mae_n", 1),
    ("MAE", "[N]", "mean_force_mae_n", 1),
    ("95% within", "[N]", "mean_force_p95_n", 1),
    ("worst", "[N]", "mean_force_worst_n", 1),
)
INTERVALS = (("inside", "[%]", "coverage", 100), ("half-width", "[N]", "half_width_n", 1))
WARPED = (
    ("angle", "[mrad]", "angle_dtw_mae_rad", 1000),
    ("angle", "scaled 1e-3", "angle_dtw_mae_scaled", 1000),
    ("force", "[mN]", "force_dtw_mae_n", 1000),
    ("force", "scaled 1e-3", "force_dtw_mae_scaled", 1000),
)


def comparison_tables(summary: JsonObject) -> str:
    """Return tables of the errors, mean force and DTW for a 120-column terminal, followed by
    notes."""
    yardstick = summary["flops_ratio_to"]
    groups = [(_heading(row, yardstick), row["horizons"]) for row in summary["groups"]]
    if (floor := summary["noise_floor"]) is not None:
        groups.append((floor["name"], floor["horizons"]))
    several = any(row["seeds"] > 1 for row in summary["groups"])
    seeds = "; mean over the seeds \N{PLUS-MINUS SIGN} half of its 95% interval" if several else ""
    scored = (
        f"{summary['test_logs']} test logs, {summary['scored'][-1]['rows']:,} rows at the "
        "longest horizon"
    )
    lines = [f"Free-running over {scored}{seeds}", *_table(ERRORS, groups)]
    scores = set[str]()
    for _, rows in groups:
        scores.update(*rows)
    if "mean_force_mae_n" in scores:
        stated = "coverage" in scores
        title = "Mean force over 200 samples" + (
            ", with the surrogate's 90% intervals" if stated else ""
        )
        lines += ["", title, *_table(MEANS + INTERVALS * stated, groups)]
    title = "DTW within 1 s: mean absolute difference after warping, physical and scaled"
    lines += ["", title, *_table(WARPED, groups), *[f"note: {note}" for note in summary["notes"]]]
    return "\n".join(lines)


def _heading(group: JsonObject, yardstick: str) -> str:
    """Return the size of a group of surrogates, relative to the group `yardstick`."""
    heading = (
        f"{group['name']}: {counted(group['seeds'], 'seed')}, {group['parameters']:,} parameters, "
        f"{group['flops_per_tick']:,} FLOPs per tick"
    )
    if group["name"] == yardstick:
        return heading
    return f"{heading} ({group['flops_ratio']:.3g} of {yardstick}'s)"


def _table(
    columns: Sequence[tuple[str, str, str, int]], groups: Sequence[tuple[str, list[JsonObject]]]
) -> list[str]:
    from softfin.cli.tables import aligned

    head = [["", *(column[i] for column in columns)] for i in (0, 1)]
    body = []
    for _, rows in groups:
        for row in rows:
            cells = [_cell(row.get(score), factor) for _, _, score, factor in columns]
            body.append([f"  {row['horizon_s']:g} s", *cells])
    lines = aligned([*head, *body])
    # All groups are aligned together; their headings are inserted afterwards.
    result = lines[:2]
    rest = iter(lines[2:])
    for heading, rows in groups:
        result += [heading, *islice(rest, len(rows))]
    return result


def _cell(cell: JsonObject | None, factor: int) -> str:
    if cell is None:
        return "\N{EN DASH}"
    # Four significant digits at most, but no exponent unless the value would be shown as 0.
    value = cell["mean"] * factor
    digits = max(0, 4 - len(str(int(abs(value)))))
    text = f"{value:.{digits}f}" if abs(value) >= 0.0005 or value == 0 else f"{value:.0e}"
    if cell["interval"] is None:
        return text
    low, high = cell["interval"]
    return f"{text} \N{PLUS-MINUS SIGN}{(high - low) / 2 * factor:.{digits}f}"


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
    from softfin.cli.tables import aligned

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
