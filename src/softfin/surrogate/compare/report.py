"""A comparison as a folder: ``comparison.json`` and ``.png``, ``.svg``: who follows the force for how long."""

from collections.abc import Mapping
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.quantities import AXES, RATE_HZ
from softfin.storage import artifact as artifacts
from softfin.storage.figures import BLACK, BLUE, GREEN, GREY, ORANGE, new_figure, save_figure, styled
from softfin.surrogate.compare.compare import Comparison, Group
from softfin.surrogate.streaming.uncertainty import COVERAGE

TRACE_S = 8
"""Of measured and predicted force, as it is shown."""

TRACES = 3
"""Groups whose traces are shown: more cover each other."""

LOOKS = ((ORANGE, "--", "o"), (BLUE, "-", "s"), (GREEN, "-.", "^"), (BLACK, ":", "D"))
"""Colour, line and marker of the groups, in turn."""


def write_comparison(
    comparison: Comparison, out: Path, facts: Mapping[str, Any], overwrite: bool = False
) -> dict[str, Any]:
    """Write the folder, whole or not at all; returns the content of its JSON.

    ================== =============================================================================================
    ``horizons_s``     in the order of all lists of horizons; ``scored``: how many ``stretches`` and ``rows`` each has,
                       and ``rows_left`` at the beginnings and ends of the logs
    ``ranges``         greatest minus least measured value of each channel in the test logs: the scaled scores are of
                       series divided by them
    ``groups``         ``name``, ``model``, ``surrogates`` (folders), ``seeds``, ``parameters``, ``flops_per_tick``,
                       ``flops_ratio`` (to the group that ``flops_ratio_to`` names), ``commands_beyond_training``
                       (share), ``furthest_beyond_training`` (over their range); ``horizons``: each ``horizon_s`` and
                       the scores of `judge` as ``mean`` and 95% ``interval`` over the seeds, null for one seed
    ``floor``          the same ``horizons`` of the plant that sets the floor; null without one
    ``notes``          what a reader should know, in words
    ================== =============================================================================================
    """
    summary = {**comparison.summary(), **facts}

    def write(folder: Path) -> None:
        (folder / "comparison.json").write_text(artifacts.dump_json(summary))
        figure = comparison_figure(comparison)
        save_figure(figure, folder, "comparison")

    artifacts.write_folder(out, write, overwrite)
    return summary


def comparison_figure(comparison: Comparison) -> Figure:
    """Force over a stretch, measured and free-running; below, error by horizon, of the mean force, of its intervals."""
    groups = comparison.groups
    stated = [group for group in groups if group.runs[0].judgements[-1].half_widths is not None]
    judged = groups[0].runs[0].judgements[-1].mean_errors is not None
    with styled():
        figure = new_figure(11, 8.2)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1))
        above, below = parts
        _draw_traces(above.subplots(2, 1, sharex=True), comparison)
        panels: Any = below.subplots(1, 1 + judged + bool(stated), squeeze=False)[0]
        _draw_horizons(panels[0], comparison)
        if judged:
            _draw_means(panels[1], comparison)
        if stated:
            _draw_reliability(panels[2], comparison, stated)
    return figure


def _looks(count: int) -> list[tuple[str, str, str]]:
    return list(islice(cycle(LOOKS), count))


def _draw_traces(panels: Any, comparison: Comparison) -> None:
    shown = comparison.groups[:TRACES]
    measured = np.asarray(comparison.measured.reading.force)
    ticks = min(TRACE_S * RATE_HZ, measured.shape[1])
    stretch, begin = _typical(comparison, ticks)
    rows = slice(begin, begin + ticks)
    time = (begin + np.arange(1, ticks + 1)) / RATE_HZ
    for axis, axes in enumerate(panels):
        axes.plot(time, measured[stretch, rows, axis], color="#BBBBBB", linewidth=2.6, label="measured")
        for group, (colour, line, _) in zip(shown, _looks(len(shown)), strict=True):
            force = np.asarray(group.runs[0].reading.force)[stretch, rows, axis]
            axes.plot(time, force, line, color=colour, linewidth=1.2, label=group.name)
        axes.set(ylabel=f"force {AXES[axis]} [N]", xlim=(time[0], time[-1]))
    rest = len(comparison.groups) - len(shown)
    others = "" if not rest else f"; {rest} more not drawn"
    title = f"A stretch of median error, free-running, the first seed of each{others}"
    panels[0].set_title(title, weight="bold", pad=22)
    panels[0].legend(ncols=1 + len(shown), loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0)
    panels[1].set_xlabel("time since the surrogate was left alone [s]")


def _typical(comparison: Comparison, ticks: int) -> tuple[int, int]:
    """Stretch of the longest horizon and its first tick, where the groups' mean square error is the median one."""
    measured = np.asarray(comparison.measured.reading.force)
    stretches, length, _ = measured.shape
    blocks = length // ticks
    errors = np.zeros((stretches, blocks))
    for group in comparison.groups:
        error = (np.asarray(group.runs[0].reading.force) - measured)[:, : blocks * ticks]
        errors += np.square(error).reshape(stretches, blocks, -1).mean(axis=2)
    stretch, block = np.unravel_index(np.argsort(errors, axis=None)[errors.size // 2], errors.shape)
    return int(stretch), int(block) * ticks


def _draw_horizons(axes: Axes, comparison: Comparison) -> None:
    summary = comparison.summary()
    places = np.arange(len(comparison.horizons_s))
    count = len(summary["groups"])
    for index, (row, (colour, line, marker)) in enumerate(zip(summary["groups"], _looks(count), strict=True)):
        for axis, face in zip(AXES, (colour, "white"), strict=True):
            cells = [each[f"force_{axis}_rmse_n"] for each in row["horizons"]]
            # Side by side, so that bars of intervals do not cover each other.
            shift = 0.03 * (2 * index + AXES.index(axis) - count + 0.5)
            axes.errorbar(
                places + shift, [cell["mean"] for cell in cells], _half_widths(cells), linestyle=line, marker=marker,
                color=colour, markerfacecolor=face, markersize=5, capsize=2, label=f"{row['name']}, {axis}",
            )  # fmt: skip
    if comparison.floor is not None and summary["floor"] is not None:
        cells = [[each[f"force_{axis}_rmse_n"]["mean"] for axis in AXES] for each in summary["floor"]["horizons"]]
        axes.plot(
            places, np.mean(cells, axis=1), color=GREY, linewidth=1.6, label=f"{comparison.floor.name}, mean of x and y"
        )
    axes.set_xticks(places, [f"{horizon:g}" for horizon in comparison.horizons_s])
    axes.set(xlabel="horizon [s]", ylabel="RMSE of the force [N]", ylim=(0, None))
    axes.set_title("Error by the time left alone")
    axes.margins(x=0.12)
    # Room for the legend, clear of the bars.
    axes.set_ylim(0, 1.6 * axes.get_ylim()[1])
    axes.legend(fontsize=7, loc="upper right")


def _half_widths(cells: list[dict[str, Any]]) -> list[float] | None:
    if cells[0]["interval"] is None:
        return None
    return [(high - low) / 2 for low, high in (cell["interval"] for cell in cells)]


def _draw_means(axes: Axes, comparison: Comparison) -> None:
    """Share of the mean forces that are off by no more than so much."""
    groups = comparison.groups
    looks = _looks(len(groups))
    drawn = [(group, colour, line, 1.4) for group, (colour, line, _) in zip(groups, looks, strict=True)]
    if comparison.floor is not None:
        drawn.append((comparison.floor, GREY, "-", 1.6))
    for group, colour, line, width in drawn:
        sizes, share = _distribution(np.abs(_pooled(group)))
        axes.plot(sizes, share, line, color=colour, linewidth=width, label=group.name)
    axes.axhline(0.95, color=GREY, linewidth=0.8, linestyle=":")
    axes.text(0.99, 0.94, "95%", color=GREY, ha="right", va="top", transform=axes.get_yaxis_transform(), fontsize=7)
    axes.set(xlabel="error of the mean force over 2 s [N]", ylabel="share within", ylim=(0, 1.02), xlim=(0, None))
    axes.set_title(f"Mean force, {comparison.horizons_s[-1]:g} s alone")
    axes.legend(fontsize=7, loc="lower right")


def _draw_reliability(axes: Axes, comparison: Comparison, stated: list[Group]) -> None:
    """Share of the errors within a multiple of the stated half-widths: at 1 it should be what was stated."""
    looks = dict(zip((group.name for group in comparison.groups), _looks(len(comparison.groups)), strict=True))
    for group in stated:
        colour, line, marker = looks[group.name]
        each = [run.judgements[-1] for run in group.runs]
        halves = np.concatenate([j.half_widths.ravel() for j in each if j.half_widths is not None])
        ratios = np.abs(_pooled(group)) / halves
        within = float(np.mean(ratios <= 1))
        axes.plot(*_distribution(ratios), line, color=colour, label=f"{group.name}: {within:.1%} inside")
        axes.plot([1], [within], marker, color=colour)
    axes.plot([1, 1], [COVERAGE - 0.05, COVERAGE + 0.05], color=GREY, linewidth=4, alpha=0.5, label="85% to 95%")
    axes.set(xlabel="error over the stated half-width", ylabel="share within", xlim=(0, 3), ylim=(0, 1.02))
    axes.set_title(f"Intervals stated at {COVERAGE:.0%}")
    axes.legend(fontsize=7, loc="lower right")


def _pooled(group: Group) -> np.ndarray:
    each = [run.judgements[-1].mean_errors for run in group.runs]
    return np.concatenate([errors.ravel() for errors in each if errors is not None])


def _distribution(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The empirical distribution at 0 and 400 quantiles: as fine as it can be seen."""
    share = np.linspace(0, 1, 401)
    return np.concatenate([[0], np.quantile(values, share)]), np.concatenate([[0], share])
