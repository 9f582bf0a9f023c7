"""Refit of a surrogate to new logs of a changed fin, compared with a fit from nothing.

    python -m studies.refit RUN --start SURROGATE                       # about an hour on two cores
    python -m studies.refit RUN --start SURROGATE --figure docs/refit.png

Each seed has its own changed tank, one-minute logs, test commands and weights. The scores
are the mean error of the predicted mean force over 200 samples and the root mean square error of
the force, both against the true force in the tank without noise and drift, in free runs from
commands alone. RUN contains a folder per fit and a file per
score; finished ones are skipped, so the same command continues a stopped study.
"""

import argparse
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softfin.core.quantities import RATE_HZ, Log
from softfin.core.randomness import named_key
from softfin.core.window import moving_average
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import write_dataset
from softfin.storage.figures import BLACK, BLUE, ORANGE, new_figure, save_figure, styled
from softfin.surrogate import load_surrogate
from softfin.surrogate.channels import SKIPPED
from softfin.tank import DomainRandomization, SensorConfig, Tank, TankConfig, sample_tank
from studies.data_efficiency import cell, spread, told

WIDTHS = DomainRandomization(
    temperature_c=0.0,
    stiffness=0.3,
    drag=0.3,
    added_mass=0.15,
    lag=0.3,
    dead_time=0.3,
    drift=0.0,
    misalignment_rad=0.0,
)
"""Half-widths of the changes of the fin, the water and the servo."""

ROWS = 60 * RATE_HZ
"""Rows of a log."""

TEST_LOGS = 4

KINDS = {
    "refit": ("refit", BLUE, "o"),
    "nothing": ("fit from nothing", ORANGE, "s"),
}
"""Title, colour and marker of each kind of fit."""

SCORES = {"mean_force_mae_n": "mean force", "force_rmse_n": "force, RMS"}

CONFIGS: dict[str, dict[str, Any]] = {
    "refit": {},
    "nothing": {"members": 3, "drive_updates": 200, "force_updates": 600, "held_out": 0.3},
}
"""Changes to the default configuration: the quick fit of docs/surrogates.md."""


def numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(",")))


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of all logs, fits and scores")
    parser.add_argument("--start", type=Path, required=True, help="surrogate to refit")
    parser.add_argument("--minutes", type=numbers, default=(1, 2, 4, 8))
    parser.add_argument("--seeds", type=numbers, default=(0, 1, 2, 3, 4))
    parser.add_argument("--figure", type=Path, help="picture to draw: a .png or .svg")
    return parser.parse_args(words)


def main(options: argparse.Namespace) -> None:
    for seed in options.seeds:
        study(options, seed)
    rows = gathered(options.run)
    artifacts.write_file(options.run / "study.json", artifacts.dump_json(rows))
    sys.stdout.write(table(rows) + "\n")
    if options.figure is not None:
        draw(rows, options.figure)


def study(options: argparse.Namespace, seed: int) -> None:
    """Record, fit and score the cases of one seed that are missing."""
    cases = [(kind, minutes) for minutes in options.minutes for kind in KINDS]
    files = {case: score_file(options.run, *case, seed) for case in [("refit", 0), *cases]}
    missing = [case for case, file in files.items() if not file.exists()]
    if not missing:
        return
    test = changed_logs(seed, "test", TEST_LOGS, is_silent=True)
    logs = changed_logs(seed, "train", max(options.minutes), is_silent=False)
    for kind, minutes in missing:
        folder = options.run / "fits" / f"{kind}-{minutes:02d}" / f"seed-{seed}"
        if minutes == 0:
            folder = options.start
        elif not artifacts.is_kind(folder, "surrogate"):
            dataset = options.run / "logs" / f"{minutes:02d}" / f"seed-{seed}"
            write_dataset(dataset, logs[:minutes], [], {"plant": "tank"}, overwrite=True)
            fit(
                dataset,
                out=folder,
                start=options.start if kind == "refit" else None,
                config=CONFIGS[kind],
                seed=seed,
                overwrite=True,
                progress=told(f"{kind}, {minutes} min, seed {seed}"),
            )
        scores = force_errors(folder, test)
        artifacts.write_file(files[kind, minutes], artifacts.dump_json(scores))


def score_file(run: Path, kind: str, minutes: int, seed: int) -> Path:
    return run / "scores" / f"{kind}-{minutes:02d}" / f"seed-{seed}.json"


def changed_logs(seed: int, part: str, count: int, is_silent: bool) -> list[Log]:
    """Record logs of the changed tank of a seed, without noise and drift if `is_silent`."""
    silent = SensorConfig(noise_n=0.0, drift_n=0.0, resolution_n=0.0)
    tank = Tank(TankConfig(sensor=silent)) if is_silent else Tank()
    changed = sample_tank(tank, named_key(seed, "refit/tank"), WIDTHS)
    keys = [named_key(seed, f"refit/{part}/{index}") for index in range(count)]
    return list(
        simulate([changed] * count, keys, ROWS, ExcitationConfig(), count, lambda rows: None)
    )


def force_errors(folder: Path, logs: Sequence[Log]) -> dict[str, float]:
    """Return the errors over both axes and all logs."""
    surrogate = load_surrogate(folder)
    *_, force = surrogate.predictions(logs).values()
    errors = []
    for predicted, log in zip(force.series, logs, strict=True):
        errors.append(predicted - np.asarray(log.reading.force)[SKIPPED:])
    means = [np.abs(moving_average(error)).mean() for error in errors]
    squares = [np.mean(error**2) for error in errors]
    return {
        "mean_force_mae_n": float(np.mean(means)),
        "force_rmse_n": float(np.sqrt(np.mean(squares))),
    }


def gathered(run: Path) -> list[dict[str, Any]]:
    """Return the mean and the standard deviation over the seeds of each case with scores."""
    rows = []
    for folder in sorted((run / "scores").iterdir()):
        kind, minutes = folder.name.split("-")
        scores = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
        row: dict[str, Any] = {"kind": kind, "minutes": int(minutes), "seeds": len(scores)}
        for name in SCORES:
            row[name] = spread([score[name] for score in scores])
        rows.append(row)
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the errors by minutes and kind, for a document."""
    known = {(row["kind"], row["minutes"]): row for row in rows}
    cases = list(itertools.product(SCORES, KINDS))
    titles = [f"{SCORES[score]}, {KINDS[kind][0]} [N]" for score, kind in cases]
    lines = [["minutes", "seeds", *titles], ["---"] * (2 + len(cases))]
    for minutes in sorted({row["minutes"] for row in rows}):
        line = [str(minutes), str(known["refit", minutes]["seeds"])]
        for score, kind in cases:
            line.append(cell(known.get((kind, minutes), {}).get(score), 1, 3))
        lines.append(line)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the errors over the minutes of new logs; bars are a standard deviation over the seeds."""
    with styled():
        figure = new_figure(5.2, 3.2)
        axes = figure.subplots()
        for kind, (title, colour, marker) in KINDS.items():
            own = [row for row in rows if row["kind"] == kind and row["minutes"]]
            axes.errorbar(
                [row["minutes"] for row in own],
                [row["mean_force_mae_n"]["mean"] for row in own],
                [row["mean_force_mae_n"]["sd"] or 0.0 for row in own],
                label=title,
                color=colour,
                marker=marker,
                markersize=4,
                capsize=2,
            )
        for row in rows:
            if row["minutes"] == 0:
                label = "before the refit"
                level = row["mean_force_mae_n"]["mean"]
                axes.axhline(level, color=BLACK, linestyle=":", linewidth=1.2, label=label)
        minutes = sorted({row["minutes"] for row in rows if row["minutes"]})
        axes.set(xlabel="new logs [min]", ylabel="error of the mean force [N]", xscale="log")
        axes.set_xticks(minutes, [str(minute) for minute in minutes])
        axes.minorticks_off()
        axes.set_ylim(bottom=0)
        axes.legend()
    save_figure(figure, path)


if __name__ == "__main__":
    main(parse())
