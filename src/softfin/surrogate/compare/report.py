"""Writes the folder of a comparison: ``comparison.json`` and a figure of the predicted forces and
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
from softfin.surrogate.protocol import COVERAGE

SHOWN_FORCE_S = 8
"""Duration of the plotted force traces [s]."""

TRACES = 3
"""Maximum number of groups with a force trace; more traces would overlap."""

SHARES = np.linspace(0, 1, 401)
"""Quantiles at which the error distributions are plotted."""

STYLES = ((ORANGE, "--", "o"), (BLUE, "-", "s"), (GREEN, "-.", "^"), (BLACK, ":", "D"))
"""Colours, line styles and markers for the groups, in order."""


def write_comparison(folder: Path, comparison: Comparison, summary: Mapping[str, object]) -> None:
    """Write the summary and the figure to the folder."""
    artifacts.write_description(folder, "comparison", summary)
    save_figure(comparison_figure(comparison), folder, "comparison")


def comparison_figure(comparison: Comparison) -> Figure:
    """Plot the measured and predicted force, and below it up to three panels of errors.

    The panels show errors against the horizon, the distribution of mean-force errors, and errors
    relative to the intervals.
    """
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
        panels = below.subplots(1, len(draw), squeeze=False)[0]
        for draw_panel, axes in zip(draw, panels, strict=True):
            draw_panel(axes, comparison)
    return figure


def _draw_traces(panels: np.ndarray, comparison: Comparison) -> None:
    measured = np.asarray(comparison.measured.reading.force)[0, : SHOWN_FORCE_S * RATE_HZ]
    # The free run starts at tick 0 with a command; its first reading follows one tick later.
    time = np.arange(1, len(measured) + 1) / RATE_HZ
    for axis, axes in enumerate(panels):
        axes.plot(time, measured[:, axis], color="#BBBBBB", linewidth=2.6, label="measured")
        for group, (colour, line, _) in zip(comparison.groups[:TRACES], STYLES, strict=False):
            force = np.asarray(group.reading.force)[0, : len(time), axis]
            axes.plot(time, force, line, color=colour, linewidth=1.2, label=group.row["name"])
        axes.set(ylabel=f"force {AXES[axis]} [N]", xlim=(time[0], time[-1]))
    rest = len(comparison.groups) - TRACES
    others = f"; {rest} more not shown" if rest > 0 else ""
    title = f"Free run over the first segment, first seed of each group{others}"
    panels[0].set_title(title, weight="bold", pad=22)
    panels[0].legend(ncols=1 + TRACES, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0)
    panels[1].set_xlabel("time since the start of the free run [s]")


def _draw_horizons(axes: Axes, comparison: Comparison) -> None:
    places = np.arange(len(comparison.summary["horizons_s"]))
    count = len(comparison.groups)
    for index, (group, (colour, line, marker)) in enumerate(
        zip(comparison.groups, cycle(STYLES), strict=False)
    ):
        for number, (axis, face) in enumerate(zip(AXES, (colour, "white"), strict=True)):
            means = []
            half_widths = []
            for row in group.row["horizons"]:
                cell = row[f"force_{axis}_rmse_n"]
                means.append(cell["mean"])
                # A single seed has no interval.
                if cell["interval"] is not None:
                    low, high = cell["interval"]
                    half_widths.append((high - low) / 2)
            # Shifted so that the error bars do not overlap: 2 * count series, centred on the tick.
            shift = 0.03 * (2 * index + number - count + 0.5)
            axes.errorbar(
                places + shift,
                means,
                # Matplotlib needs None instead of an empty list.
                half_widths or None,
                linestyle=line,
                marker=marker,
                color=colour,
                markerfacecolor=face,
                markersize=5,
                capsize=2,
                label=f"{group.row['name']}, {axis}",
            )
    if comparison.noise_floor is not None:
        _draw_noise_floor(axes, comparison.noise_floor)
    axes.set_xticks(places, [f"{horizon:g}" for horizon in comparison.summary["horizons_s"]])
    axes.set(
        xlabel="horizon [s]",
        ylabel="RMSE of the force [N]",
        ylim=(0, None),
        title="Error vs. horizon",
    )
    axes.margins(x=0.12)
    # Space for the legend above the error bars.
    axes.set_ylim(0, 1.6 * axes.get_ylim()[1])
    axes.legend(fontsize=7, loc="upper right")


def _draw_noise_floor(axes: Axes, noise_floor: Group) -> None:
    horizons = noise_floor.row["horizons"]
    errors = np.zeros((len(AXES), len(horizons)))
    for number, axis in enumerate(AXES):
        for index, row in enumerate(horizons):
            errors[number, index] = row[f"force_{axis}_rmse_n"]["mean"]
    label = f"{noise_floor.row['name']}, mean of x and y"
    places = np.arange(len(horizons))
    axes.plot(places, errors.mean(axis=0), color=GREY, linewidth=1.6, label=label)


def _draw_means(axes: Axes, comparison: Comparison) -> None:
    """Plot the cumulative distribution of the mean-force errors."""
    styled_groups = []
    for group, (colour, line, _) in zip(comparison.groups, cycle(STYLES), strict=False):
        styled_groups.append((group, colour, line, 1.4))
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
        ylabel="fraction within",
        ylim=(0, 1.02),
        xlim=(0, None),
    )
    axes.locator_params(axis="x", nbins=5)
    axes.set_title(f"Mean force in free runs of {comparison.summary['horizons_s'][-1]:g} s")
    axes.legend(fontsize=7, loc="lower right")


def _draw_reliability(axes: Axes, comparison: Comparison) -> None:
    """Plot the cumulative distribution of errors divided by the stated half-widths.

    At a ratio of 1 it should equal the stated coverage.
    """
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
        xlabel="error / stated half-width",
        ylabel="fraction within",
        xlim=(0, 3),
        ylim=(0, 1.02),
    )
    axes.set_title(f"Coverage of the {COVERAGE:.0%} intervals")
    axes.legend(fontsize=7, loc="lower right")


def _pooled(group: Group, field: str) -> np.ndarray:
    """Return a field of the scores at the longest horizon, pooled over all seeds."""
    return np.concatenate([np.ravel(getattr(scores, field)) for scores in group.longest])
