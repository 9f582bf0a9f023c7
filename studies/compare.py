"""Scores surrogates in free runs over the same rows of the test logs of a dataset:

    python -m studies.compare streaming paper --dataset dataset --noise-floor tank --out comparison

Writes comparison.json and a figure. The noise floor is a plant that records the same commands
again, such as the recorded tank: its error is that of the noise and drift of both recordings.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.flops import flops_per_tick
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.errors import ArtifactError
from softfin.core.plant import Plant
from softfin.core.quantities import AXES, RATE_HZ, Log, Reading
from softfin.core.randomness import named_key
from softfin.storage.dataset import Dataset
from softfin.storage.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    new_figure,
    save_figure,
    styled,
)
from softfin.storage.registry import find_plant
from softfin.surrogate import SurrogatePlant, load_surrogate
from softfin.surrogate.protocol import COVERAGE
from studies.free_runs import (
    Means,
    free_run,
    mean_force_errors,
    plan_segments,
    run_from_rest,
    score_segments,
    take,
)

HORIZONS_S = (1.0, 5.0, 30.0)
"""Durations of the free runs [s]. 30 s is much longer than the memory of the fin."""

SHOWN_S = 8
"""Duration of the plotted force traces [s]."""

SHARES = np.linspace(0, 1, 401)
"""Quantiles at which the error distributions are plotted."""

STYLES = ((ORANGE, "--", "o"), (BLUE, "-", "s"), (GREEN, "-.", "^"), (BLACK, ":", "D"))
"""Colours, line styles and markers of the surrogates, in order."""


class Candidate(NamedTuple):
    """Scores of one surrogate or of the noise floor, and its predictions at the longest horizon."""

    name: str
    horizons: list[dict[str, float]]
    """Scores at each horizon."""
    reading: Reading
    mean_errors: Means | None
    """Errors of the mean force; None if the longest horizon is shorter than its window."""
    half_widths: Means | None


class Comparison(NamedTuple):
    """Candidates on the same rows."""

    horizons_s: tuple[float, ...]
    candidates: list[Candidate]
    noise_floor: Candidate | None
    measured: Reading
    """Measured segments of the longest horizon."""


def compare(
    surrogates: dict[str, SurrogatePlant],
    logs: Sequence[Log],
    horizons_s: Sequence[float] = HORIZONS_S,
    noise_floor: Plant | None = None,
    seed: int = 0,
) -> Comparison:
    """Score surrogates, by name, and the noise floor, with noise of `seed`."""
    # The longest warm-up applies to all, so that all are scored on the same rows.
    warm_up = max(surrogate.memory for surrogate in surrogates.values())
    rows = [log.rows for log in logs]
    parts = []
    for horizon_s in horizons_s:
        ticks = round(horizon_s * RATE_HZ)
        parts.append((plan_segments(rows, ticks, warm_up), ticks))
    measured = [take(logs, *part).reading for part in parts]
    candidates = []
    for name, surrogate in surrogates.items():
        runs = [free_run(surrogate, logs, *part) for part in parts]
        readings = [run.reading for run in runs]
        widths = [run.half_widths for run in runs]
        candidates.append(_score(name, measured, readings, widths))
    floor = None
    if noise_floor is not None:
        # A plant cannot be warmed up from a log, so it replays each log from its first row.
        replayed = run_from_rest(noise_floor, logs, named_key(seed, "compare/floor"))
        readings = [take(replayed, *part) for part in parts]
        floor = _score("second recording", measured, readings, [None] * len(parts))
    return Comparison(tuple(horizons_s), candidates, floor, measured[-1])


def _score(
    name: str,
    measured: Sequence[Reading],
    readings: Sequence[Reading],
    half_widths: Sequence[Means | None],
) -> Candidate:
    horizons = []
    for actual, reading, widths in zip(measured, readings, half_widths, strict=True):
        horizons.append(score_segments(actual, reading, widths))
    mean_errors = None
    if "mean_force_mae_n" in horizons[-1]:
        mean_errors = mean_force_errors(measured[-1], readings[-1])
    return Candidate(name, horizons, readings[-1], mean_errors, half_widths[-1])


def load_test_logs(dataset: Path) -> list[Log]:
    """Load the test logs of a dataset."""
    data = Dataset.open(dataset)
    if not data.test:
        raise ArtifactError(f"{dataset}: contains no test logs; put logs into {dataset / 'test'}")
    return list(data.load(data.test))


def comparison_figure(comparison: Comparison) -> Figure:
    """Plot the measured and predicted force, and below it the errors over the horizon, the
    distribution of the mean force's errors, and these relative to the intervals."""
    with styled():
        figure = new_figure(11, 8.2)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1))
        _draw_traces(parts[0].subplots(2, 1, sharex=True), comparison)
        horizons, means, reliability = parts[1].subplots(1, 3)
        _draw_horizons(horizons, comparison)
        _draw_means(means, comparison)
        _draw_reliability(reliability, comparison)
    return figure


def _draw_traces(panels: np.ndarray, comparison: Comparison) -> None:
    measured = np.asarray(comparison.measured.force)[0, : SHOWN_S * RATE_HZ]
    # The free run starts at tick 0 with a command; its first reading follows one tick later.
    time = np.arange(1, len(measured) + 1) / RATE_HZ
    for axis, axes in enumerate(panels):
        axes.plot(time, measured[:, axis], color="#BBBBBB", linewidth=2.6, label="measured")
        for candidate, (colour, line, _) in zip(comparison.candidates, STYLES, strict=False):
            force = np.asarray(candidate.reading.force)[0, : len(time), axis]
            axes.plot(time, force, line, color=colour, linewidth=1.2, label=candidate.name)
        axes.set(ylabel=f"force {AXES[axis]} [N]", xlim=(time[0], time[-1]))
    panels[0].set_title("Free run over the first segment", weight="bold", pad=22)
    panels[0].legend(ncols=4, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0)
    panels[1].set_xlabel("time since the start of the free run [s]")


def _draw_horizons(axes: Axes, comparison: Comparison) -> None:
    places = np.arange(len(comparison.horizons_s))
    for candidate, (colour, line, marker) in zip(comparison.candidates, STYLES, strict=False):
        for axis, face in zip(AXES, (colour, "white"), strict=True):
            axes.plot(
                places,
                [scores[f"force_{axis}_rmse_n"] for scores in candidate.horizons],
                line,
                marker=marker,
                color=colour,
                markerfacecolor=face,
                markersize=5,
                label=f"{candidate.name}, {axis}",
            )
    if comparison.noise_floor is not None:
        axes.plot(
            places,
            [
                (scores["force_x_rmse_n"] + scores["force_y_rmse_n"]) / 2
                for scores in comparison.noise_floor.horizons
            ],
            color=GREY,
            linewidth=1.6,
            label="second recording",
        )
    axes.set_xticks(places, [f"{horizon_s:g}" for horizon_s in comparison.horizons_s])
    axes.set(xlabel="horizon [s]", ylabel="RMSE of the force [N]", title="Error vs. horizon")
    axes.margins(x=0.12)
    # Space for the legend above the lines.
    axes.set_ylim(0, 1.6 * axes.get_ylim()[1])
    axes.legend(fontsize=7, loc="upper right")


def _draw_means(axes: Axes, comparison: Comparison) -> None:
    """Plot the cumulative distribution of the mean-force errors."""
    shown = list(zip(comparison.candidates, STYLES, strict=False))
    if comparison.noise_floor is not None:
        shown.append((comparison.noise_floor, (GREY, "-", "")))
    for candidate, (colour, line, _) in shown:
        if candidate.mean_errors is not None:
            sizes = np.quantile(np.abs(candidate.mean_errors), SHARES)
            axes.plot(sizes, SHARES, line, color=colour, label=candidate.name)
    axes.axhline(0.95, color=GREY, linewidth=0.8, linestyle=":")
    axes.set(xlabel="error of the mean force over 2 s [N]", ylabel="fraction within")
    axes.set(ylim=(0, 1.02), xlim=(0, None))
    axes.set_title(f"Mean force in free runs of {comparison.horizons_s[-1]:g} s")
    axes.legend(fontsize=7, loc="lower right")


def _draw_reliability(axes: Axes, comparison: Comparison) -> None:
    """Plot the cumulative distribution of errors divided by the stated half-widths.

    At a ratio of 1 it should equal the stated coverage.
    """
    for candidate, (colour, line, marker) in zip(comparison.candidates, STYLES, strict=False):
        if candidate.half_widths is None or candidate.mean_errors is None:
            continue
        ratios = np.abs(candidate.mean_errors) / candidate.half_widths
        within = float(np.mean(ratios <= 1))
        label = f"{candidate.name}: {within:.1%} inside"
        axes.plot(np.quantile(ratios, SHARES), SHARES, line, color=colour, label=label)
        axes.plot([1], [within], marker, color=colour)
    axes.plot([1, 1], [0.85, 0.95], color=GREY, linewidth=4, alpha=0.5, label="85% to 95%")
    axes.set(xlabel="error / stated half-width", ylabel="fraction within")
    axes.set(xlim=(0, 3), ylim=(0, 1.02))
    axes.set_title(f"Coverage of the {COVERAGE:.0%} intervals")
    axes.legend(fontsize=7, loc="lower right")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("surrogates", type=Path, nargs="+")
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--horizons", type=float, nargs="+", default=HORIZONS_S)
    parser.add_argument("--noise-floor")
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    logs = load_test_logs(words.dataset)
    surrogates = {folder.name: load_surrogate(folder) for folder in words.surrogates}
    floor = None if words.noise_floor is None else find_plant(words.noise_floor)
    comparison = compare(surrogates, logs, sorted(words.horizons), floor, words.seed)
    summary: dict[str, Any] = {"horizons_s": comparison.horizons_s, "surrogates": []}
    for candidate in comparison.candidates:
        surrogate = surrogates[candidate.name]
        row = {
            "name": candidate.name,
            "model": surrogate.model,
            "parameters": surrogate.parameters(),
            "flops_per_tick": flops_per_tick(surrogate),
            "horizons": candidate.horizons,
        }
        summary["surrogates"].append(row)
    if comparison.noise_floor is not None:
        summary["noise_floor"] = {"horizons": comparison.noise_floor.horizons}
    words.out.mkdir(parents=True, exist_ok=True)
    (words.out / "comparison.json").write_text(json.dumps(summary, indent=1))
    save_figure(comparison_figure(comparison), words.out / "comparison.png")
    for candidate in filter(None, (*comparison.candidates, comparison.noise_floor)):
        for horizon_s, scores in zip(comparison.horizons_s, candidate.horizons, strict=True):
            values = ", ".join(f"{name} {value:.4g}" for name, value in scores.items())
            print(f"{candidate.name}, {horizon_s:g} s: {values}")


if __name__ == "__main__":
    main()
