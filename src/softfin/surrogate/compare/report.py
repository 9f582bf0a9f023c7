"""Writes a comparison as a folder: ``comparison.json``, and a figure of the predicted forces and
their errors."""

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softfin.core.quantities import AXES, RATE_HZ
from softfin.storage import artifact as artifacts
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
from softfin.surrogate.compare.compare import Comparison, Group
from softfin.surrogate.streaming.ensemble import COVERAGE

SHOWN_FORCE_S = 8
"""Length of the force that is shown, measured and predicted [s]."""

TRACES = 3
"""Number of groups whose traces are shown; more would cover each other."""

SHARES = np.linspace(0, 1, 401)
"""Quantiles at which distributions are drawn."""

STYLES = ((ORANGE, "--", "o"), (BLUE, "-", "s"), (GREEN, "-.", "^"), (BLACK, ":", "D"))
"""Colours, lines and markers of the groups, in turn."""


def write_comparison(folder: Path, comparison: Comparison, summary: Mapping[str, object]) -> None:
    """Fill the folder with the summary and the figure."""
    artifacts.write_description(folder, "comparison", summary)
    save_figure(comparison_figure(comparison), folder, "comparison")


def comparison_figure(comparison: Comparison) -> Figure:
    """Draw the force over a segment, measured and predicted; below it the errors by horizon, of the
    mean force, and relative to the intervals."""
    longest = [group.longest[0] for group in comparison.groups]
    draw = [_draw_horizons]
    if longest[0].mean_errors is not None:
        draw.append(_draw_means)
    if any(scores.half_widths is not None for scores in longest):
        draw.append(_draw_reliability)
    with styled():
        figure = new_figure(11, 8.2)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1))
        above, below = parts
        _draw_traces(above.subplots(2, 1, sharex=True), comparison)
        for draw_panel, axes in zip(
            draw, below.subplots(1, len(draw), squeeze=False)[0], strict=True
        ):
            draw_panel(axes, comparison)
    return figure


def _draw_traces(panels: Any, comparison: Comparison) -> None:
    measured = np.asarray(comparison.measured.reading.force)[0, : SHOWN_FORCE_S * RATE_HZ]
    time = np.arange(1, len(measured) + 1) / RATE_HZ
    for axis, axes in enumerate(panels):
        axes.plot(time, measured[:, axis], color="#BBBBBB", linewidth=2.6, label="measured")
        for group, (colour, line, _) in zip(comparison.groups[:TRACES], STYLES, strict=False):
            force = np.asarray(group.reading.force)[0, : len(time), axis]
            axes.plot(time, force, line, color=colour, linewidth=1.2, label=group.row["name"])
        axes.set(ylabel=f"force {AXES[axis]} [N]", xlim=(time[0], time[-1]))
    rest = len(comparison.groups) - TRACES
    others = f"; {rest} more not shown" if rest > 0 else ""
    title = f"The first segment, free-running, the first seed of each{others}"
    panels[0].set_title(title, weight="bold", pad=22)
    panels[0].legend(ncols=1 + TRACES, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0)
    panels[1].set_xlabel("time since the surrogate began to run free [s]")


def _draw_horizons(axes: Axes, comparison: Comparison) -> None:
    places = np.arange(len(comparison.summary["horizons_s"]))
    count = len(comparison.groups)
    for index, (group, (colour, line, marker)) in enumerate(
        zip(comparison.groups, cycle(STYLES), strict=False)
    ):
        for number, (axis, face) in enumerate(zip(AXES, (colour, "white"), strict=True)):
            cells = [row[f"force_{axis}_rmse_n"] for row in group.row["horizons"]]
            intervals = [cell["interval"] for cell in cells if cell["interval"] is not None]
            # Shifted, so that the bars of intervals do not cover each other.
            shift = 0.03 * (2 * index + number - count + 0.5)
            axes.errorbar(
                places + shift,
                [cell["mean"] for cell in cells],
                [(high - low) / 2 for low, high in intervals] or None,
                linestyle=line,
                marker=marker,
                color=colour,
                markerfacecolor=face,
                markersize=5,
                capsize=2,
                label=f"{group.row['name']}, {axis}",
            )
    if (second := comparison.noise_floor) is not None:
        errors = np.zeros((len(AXES), len(places)))
        for number, axis in enumerate(AXES):
            for index, row in enumerate(second.row["horizons"]):
                errors[number, index] = row[f"force_{axis}_rmse_n"]["mean"]
        label = f"{second.row['name']}, mean of x and y"
        axes.plot(places, errors.mean(axis=0), color=GREY, linewidth=1.6, label=label)
    axes.set_xticks(places, [f"{horizon:g}" for horizon in comparison.summary["horizons_s"]])
    axes.set(
        xlabel="horizon [s]",
        ylabel="RMSE of the force [N]",
        ylim=(0, None),
        title="Error by the horizon",
    )
    axes.margins(x=0.12)
    # Room for the legend, clear of the bars.
    axes.set_ylim(0, 1.6 * axes.get_ylim()[1])
    axes.legend(fontsize=7, loc="upper right")


def _draw_means(axes: Axes, comparison: Comparison) -> None:
    """Draw the fraction of mean forces with an error up to each value."""
    styled_groups = [
        (group, *style[:2], 1.4)
        for group, style in zip(comparison.groups, cycle(STYLES), strict=False)
    ]
    if comparison.noise_floor is not None:
        styled_groups.append((comparison.noise_floor, GREY, "-", 1.6))
    for group, colour, line, width in styled_groups:
        sizes = np.quantile(np.abs(_pooled(group, "mean_errors")), SHARES)
        axes.plot(sizes, SHARES, line, color=colour, linewidth=width, label=group.row["name"])
    axes.axhline(0.95, color=GREY, linewidth=0.8, linestyle=":")
    axes.text(
        0.99,
        0.94,
        "95%",
        color=GREY,
        ha="right",
        va="top",
        transform=axes.get_yaxis_transform(),
        fontsize=7,
    )
    axes.set(
        xlabel="error of the mean force over 2 s [N]",
        ylabel="share within",
        ylim=(0, 1.02),
        xlim=(0, None),
    )
    axes.locator_params(axis="x", nbins=5)
    axes.set_title(f"Mean force, free-running for {comparison.summary['horizons_s'][-1]:g} s")
    axes.legend(fontsize=7, loc="lower right")


def _draw_reliability(axes: Axes, comparison: Comparison) -> None:
    """Draw the fraction of errors within a multiple of the stated half-widths: at 1 it should equal
    the stated coverage."""
    for group, (colour, line, marker) in zip(comparison.groups, cycle(STYLES), strict=False):
        if group.longest[0].half_widths is None:
            continue
        ratios = np.abs(_pooled(group, "mean_errors")) / _pooled(group, "half_widths")
        within = float(np.mean(ratios <= 1))
        label = f"{group.row['name']}: {within:.1%} inside"
        axes.plot(np.quantile(ratios, SHARES), SHARES, line, color=colour, label=label)
        axes.plot([1], [within], marker, color=colour)
    axes.plot(
        [1, 1],
        [COVERAGE - 0.05, COVERAGE + 0.05],
        color=GREY,
        linewidth=4,
        alpha=0.5,
        label="85% to 95%",
    )
    axes.set(
        xlabel="error over the stated half-width",
        ylabel="share within",
        xlim=(0, 3),
        ylim=(0, 1.02),
    )
    axes.set_title(f"Intervals stated at {COVERAGE:.0%}")
    axes.legend(fontsize=7, loc="lower right")


def _pooled(group: Group, field: str) -> np.ndarray:
    return np.concatenate([np.ravel(getattr(scores, field)) for scores in group.longest])
