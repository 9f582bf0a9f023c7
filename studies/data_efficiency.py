"""How long to record: free-running error against minutes of tank time.

    python -m studies.data_efficiency RUN                                            # all of it: hours on two cores
    python -m studies.data_efficiency RUN --minutes 2,5,10 --members 3 --force-updates 800

Every recording, fit and score has a place of its own under RUN and is left out where it is there
already: the same command goes on after a stop, and sizes, seeds and models can be added one after
another. RUN/study.json and the table on standard output hold whatever is there by then; --figure
draws it. A seed is other logs and other weights.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.ticker import LogLocator

from softfin.core.quantities import RATE_HZ, Log, Reading
from softfin.core.randomness import named_key
from softfin.stages.collect import collect
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, save_figure, styled
from softfin.surrogate import load_surrogate
from softfin.tank import SensorConfig, Tank, TankConfig
from studies.free_runs import free_run, plan_segments, run_from_rest, score_segments, take

MINUTE = 60 * RATE_HZ
"""Rows of a log to learn from."""

HORIZON = 30 * RATE_HZ
FIRST = 3 * RATE_HZ
"""Row of a test log that the first stretch begins at: every kind of surrogate is warm by then."""

TEST_SEED = 1_000_000
"""Far from those of the logs to learn from."""

COLUMNS = {
    "angle_rmse_rad": ("angle RMSE [mrad]", 1000, 2),
    "force_x_rmse_n": ("force x RMSE [N]", 1, 3),
    "force_y_rmse_n": ("force y RMSE [N]", 1, 3),
    "force_sd_n": ("less offset [N]", 1, 3),
    "force_p999_n": ("99.9% within [N]", 1, 2),
    "mean_force_mae_n": ("mean force MAE [N]", 1, 3),
    "coverage": ("in 90% interval [%]", 100, 0),
}
"""Scores in the table: title, factor, digits."""

KINDS = {"again": "the tank, recorded again", "silent": "the tank, without noise and drift"}
"""Of the floors, in the table."""

PANELS = {
    "force_sd_n": ("force error less offset: standard deviation [N]", 1),
    "force_p999_n": ("99.9% of them within [N]", 1),
    "mean_force_mae_n": ("mean force: mean |error| [N]", 1),
}
SETS = {
    "silent": "the same tank, without noise and drift",
    "same": "the same tank",
    "other": "perturbed tanks",
}
"""What is tested on; the first under the commands of the second: what the fin does, and no sensor
adds to."""

LOOKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"))
"""Of the sets: colour, marker."""


def numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(",")))


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of all recordings, fits and scores")
    # Minutes of random excitation that streaming networks and the paper's are fitted to.
    parser.add_argument("--minutes", type=numbers, default=(2, 5, 10, 30, 100, 333))
    parser.add_argument("--paper", type=numbers, default=())
    parser.add_argument("--seeds", type=numbers, default=(0, 1, 2), help="of logs and weights")
    parser.add_argument("--members", type=int, help="of the streaming ensemble")
    parser.add_argument("--drive-updates", type=int)
    parser.add_argument("--force-updates", type=int)
    # Datasets in place of those that are recorded: to learn from, cut into minutes; to test on.
    parser.add_argument("--logs", type=Path)
    parser.add_argument("--same", type=Path)
    parser.add_argument("--other", type=Path)
    parser.add_argument("--figure", type=Path, help="picture to draw: a .png or .svg")
    return parser.parse_args(words)


def main(options: argparse.Namespace) -> None:
    tests = {"same": test_logs(options, "same"), "other": test_logs(options, "other")}
    tests["silent"] = without_sensor(options.run, tests["same"])
    for minutes in options.minutes:
        for seed in options.seeds:
            study(options, "random", minutes, seed, tests)
    for minutes in options.paper:
        for seed in options.seeds[:1]:
            study(options, "paper", minutes, seed, tests)
    floor(options.run, tests)
    rows = gathered(options.run)
    artifacts.write_file(options.run / "study.json", artifacts.dump_json(rows))
    for name in SETS:
        sys.stdout.write(table(rows, name) + "\n\n")
    if options.figure is not None:
        draw(rows, options.figure)


def study(
    options: argparse.Namespace, kind: str, minutes: int, seed: int, tests: dict[str, list[Log]]
) -> None:
    """Record, fit and score one case, or whatever of it is not there yet."""
    name = f"{kind}-{minutes:03d}/seed-{seed}"
    fitted = options.run / "fits" / name
    scores = options.run / "scores" / f"{name}.json"
    if not artifacts.is_kind(fitted, "surrogate"):
        paper = kind == "paper"
        logs = learning_logs(options, minutes, seed)
        sizes = ("members", "drive_updates", "force_updates")
        given = {size: getattr(options, size) for size in sizes}
        config = {} if paper else {size: value for size, value in given.items() if value}
        model = "paper" if paper else "streaming"
        report = told(name)
        fit(logs, out=fitted, model=model, config=config, seed=seed, resume=True, progress=report)
    if not scores.exists():
        surrogate = load_surrogate(fitted)
        found = {name: scored(surrogate, logs) for name, logs in tests.items()}
        artifacts.write_file(scores, artifacts.dump_json(found))


def learning_logs(options: argparse.Namespace, minutes: int, seed: int) -> Path:
    """A dataset of logs of a minute each; those of one seed begin alike."""
    path = options.run / "logs" / f"random-{minutes:03d}" / f"seed-{seed}"
    if artifacts.is_kind(path, "dataset"):
        return path
    if options.logs is not None:
        write_dataset(
            path,
            pieces(options.logs, minutes, seed),
            [],
            {"plant": "tank", "cut_from": str(options.logs)},
        )
    else:
        sizes = {"logs": minutes, "test_logs": 0, "rows": MINUTE}
        collect(out=path, **sizes, seed=seed, progress=told(path.name))
    return path


def pieces(folder: Path, minutes: int, seed: int) -> list[Log]:
    """Minutes of a dataset's training logs; every seed begins elsewhere. What is left of a log is
    not used."""
    data = Dataset.open(folder)
    logs: list[Log] = []
    count = len(data.train)
    for index in range(count):
        (log,) = data.load([data.train[(index + seed * count // 3) % count]])
        starts = range(0, len(log.reading.time) - MINUTE + 1, MINUTE)
        logs += [
            jax.tree.map(lambda x, start=start: x[start : start + MINUTE], log) for start in starts
        ]
        if len(logs) >= minutes:
            return logs[:minutes]
    raise SystemExit(
        f"{folder}: {len(logs)} minutes, {minutes} are needed; record more, or leave --logs out"
    )


def test_logs(options: argparse.Namespace, name: str) -> list[Log]:
    """Ten of the same tank, three of perturbed tanks, 20,000 rows each, recorded once."""
    given = {"same": options.same, "other": options.other}[name]
    path = given or options.run / "logs" / f"test-{name}"
    if given is None and not artifacts.is_kind(path, "dataset"):
        counts = {"same": {"logs": 10, "test_logs": 0}, "other": {"logs": 1, "test_logs": 3}}[name]
        collect(out=path, **counts, seed=TEST_SEED, progress=told(path.name))
    data = Dataset.open(path)
    return list(data.load((data.train if name == "same" else data.test)[:10]))


def scored(surrogate: Any, logs: Sequence[Log]) -> dict[str, float]:
    """Left alone for 30 s, again and again."""
    where = stretches(logs)
    run = free_run(surrogate, logs, where, HORIZON)
    measured = take(logs, where, HORIZON).reading
    scores = score_segments(measured, run.reading, run.half_widths)
    return scores | offset_free(run.reading, measured)


def offset_free(predicted: Reading, measured: Reading) -> dict[str, float]:
    """Of the force error less its mean: what drift in the logs to learn from has no part in; both
    axes together [N]."""
    error = np.asarray(predicted.force, np.float64) - measured.force
    error -= error.mean(axis=(0, 1))
    return {
        "force_sd_n": float(error.std()),
        "force_p999_n": float(np.quantile(np.abs(error), 0.999)),
    }


def floor(run: Path, tests: dict[str, list[Log]]) -> None:
    """The tank itself under the commands of the test logs, with other noise and drift, and with
    none."""
    for kind, plant in {"again": Tank(), "silent": silent()}.items():
        path = run / "scores" / f"{kind}-000" / "seed-0.json"
        if path.exists():
            continue
        found = {}
        for name, logs in tests.items():
            where = stretches(logs)
            measured, second = (
                take(some, where, HORIZON).reading for some in (logs, again(plant, logs))
            )
            found[name] = score_segments(measured, second) | offset_free(second, measured)
        artifacts.write_file(path, artifacts.dump_json(found))


def without_sensor(run: Path, logs: Sequence[Log]) -> list[Log]:
    """What the fin did in these logs, but for noise and drift."""
    path = run / "logs" / "test-silent"
    if not artifacts.is_kind(path, "dataset"):
        write_dataset(path, again(silent(), logs), [], {"plant": "tank"})
    data = Dataset.open(path)
    return list(data.load(data.train))


def again(plant: Tank, logs: Sequence[Log]) -> list[Log]:
    """The same commands once more, from rest."""
    readings = run_from_rest(plant, logs, named_key(TEST_SEED, "again"))
    return [Log(log.command, reading) for log, reading in zip(logs, readings, strict=True)]


def silent() -> Tank:
    """The tank with a sensor that neither is noisy nor drifts."""
    return Tank(TankConfig(sensor=SensorConfig(noise_n=0.0, drift_n=0.0, resolution_n=0.0)))


def stretches(logs: Sequence[Log]) -> Any:
    return plan_segments([len(log.reading.time) for log in logs], HORIZON, FIRST)


def gathered(run: Path) -> list[dict[str, Any]]:
    """Every case that has scores: mean and standard deviation over its seeds; the floors last."""
    rows = []
    for folder in sorted((run / "scores").iterdir()):
        kind, minutes = folder.name.rsplit("-", 1)
        seeds = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
        sets = {
            name: {score: spread([seed[name].get(score) for seed in seeds]) for score in COLUMNS}
            for name in SETS
        }
        rows.append({"kind": kind, "minutes": int(minutes), "seeds": len(seeds), **sets})
    return sorted(
        rows,
        key=lambda row: (
            row["kind"] in KINDS,
            row["kind"] != "random",
            row["kind"],
            row["minutes"],
        ),
    )


def spread(values: list[float | None]) -> dict[str, float | None] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {
        "mean": statistics.mean(known),
        "sd": statistics.stdev(known) if len(known) > 1 else None,
    }


def table(rows: Sequence[dict[str, Any]], name: str) -> str:
    """For a document: a line a case."""
    titles = [f"on {SETS[name]}", "minutes", "seeds", *(title for title, _, _ in COLUMNS.values())]
    lines = [titles, ["---"] * len(titles)]
    for row in rows:
        cells = [
            cell(row[name][score], factor, digits) for score, (_, factor, digits) in COLUMNS.items()
        ]
        lines.append(
            [
                KINDS.get(row["kind"], row["kind"]),
                str(row["minutes"] or "\N{EN DASH}"),
                str(row["seeds"]),
                *cells,
            ]
        )
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cell(value: dict[str, float | None] | None, factor: float, digits: int) -> str:
    if value is None:
        return "\N{EN DASH}"
    text = f"{value['mean'] * factor:.{digits}f}"
    return (
        text
        if value["sd"] is None
        else f"{text} \N{PLUS-MINUS SIGN} {value['sd'] * factor:.{digits}f}"
    )


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Errors over minutes, both axes logarithmic; bars: a standard deviation over the seeds, either
    way.

    Dotted is the tank without noise and drift: a model cannot be better.
    """
    with styled():
        figure = new_figure(9.6, 3.2)
        panels: Any = figure.subplots(1, len(PANELS))
        for axes, (score, (title, factor)) in zip(panels, PANELS.items(), strict=True):
            for (name, label), (colour, marker) in zip(SETS.items(), LOOKS, strict=True):
                look = {"color": colour, "marker": marker, "markersize": 4, "capsize": 2}
                curve(
                    axes,
                    [row for row in rows if row["kind"] == "random"],
                    name,
                    score,
                    factor,
                    label=label,
                    **look,
                )
                level = next(
                    (row[name][score]["mean"] for row in rows if row["kind"] == "silent"), 0.0
                )
                # The tank itself has no error where nothing is added to it.
                if level > 0:
                    axes.axhline(level * factor, color=colour, linestyle=":", linewidth=1.2)
            axes.set(title=title, xlabel="tank time [min]", xscale="log", yscale="log")
            minutes = sorted({row["minutes"] for row in rows if row["minutes"]})
            axes.set_xticks(minutes, [str(minute) for minute in minutes])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
        panels[0].plot([], [], color=BLACK, linestyle=":", label="the tank itself")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    save_figure(figure, path)


def curve(
    axes: Any, rows: Sequence[dict[str, Any]], name: str, score: str, factor: float, **look: Any
) -> None:
    rows = sorted(rows, key=lambda row: row["minutes"])
    means = [row[name][score]["mean"] * factor for row in rows]
    deviations = [(row[name][score]["sd"] or 0.0) * factor for row in rows]
    axes.errorbar([row["minutes"] for row in rows], means, deviations, **look)


def told(name: str) -> Any:
    """Progress as lines on standard error, one each tenth."""
    last = -1

    def report(stage: str, done: float, note: str) -> None:
        nonlocal last
        if int(done * 10) != last:
            last = int(done * 10)
            sys.stderr.write(f"{name}: {stage} {done:.0%} {note}\n")

    return report


if __name__ == "__main__":
    main(parse())
