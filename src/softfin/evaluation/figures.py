"""Figures of experiments and scores: recordings and summaries in, Matplotlib figures out; `style` writes them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.projections.polar import PolarAxes

from softfin.core.action_clock import WINDOW
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.window import moving_average
from softfin.evaluation.experiment import Recording
from softfin.evaluation.moving import Moving
from softfin.evaluation.paper import PAPER_TABLE_II
from softfin.evaluation.response import SETTLED_N
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled

TRAJECTORY_SECONDS = 5
FORCE_SECONDS = 10
"""Of the start of an experiment, as the paper's evaluation figure shows them."""

CONTROLLER_COLOURS = {"single": BLUE, "grid": ORANGE}


def experiments_figure(recording: Recording) -> Figure:
    """Every reference of a recording, at its first seed: the fin's trajectory, and the force on both axes."""
    count = len(recording.reference)
    columns = min(count, 2)
    rows = math.ceil(count / columns)
    shown = recording.reading.force[:, 0, : FORCE_SECONDS * RATE_HZ]
    low = np.floor(np.minimum(shown.min(axis=(0, 1)), recording.reference.min(axis=0)))
    high = np.ceil(np.maximum(shown.max(axis=(0, 1)), recording.reference.max(axis=0)))
    with styled():
        figure = new_figure(6.6 * columns, 0.5 + 3.1 * rows)
        panels: Any = figure.subfigures(rows, columns, squeeze=False).flat
        for index in range(count):
            _draw_experiment(panels[index], recording, index, np.stack([low, high], axis=1))
        handles, labels = figure.get_axes()[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def _draw_experiment(panel: SubFigure, recording: Recording, index: int, limits: Any) -> None:
    reference = recording.reference[index]
    grid = panel.add_gridspec(2, 2, width_ratios=(1, 1.7))
    polar = panel.add_subplot(grid[:, 0], projection="polar")
    _draw_trajectory(polar, recording.reading.angle[index, 0])
    above = panel.add_subplot(grid[0, 1])
    below = panel.add_subplot(grid[1, 1], sharex=above)
    above.tick_params(labelbottom=False)
    for axis, axes in enumerate((above, below)):
        _draw_force(axes, recording.reading.force[index, 0, :, axis], float(reference[axis]))
        low, high = limits[axis]
        # A sensor that is dead, or a fin that stands, draws a level line.
        axes.set(ylabel=f"force {AXES[axis]} [N]", ylim=(low, high) if high > low else (low - 1, high + 1))
    above.set_title(f"reference ({reference[0]:g}, {reference[1]:g}) N".replace("-", "\N{MINUS SIGN}"), weight="bold")
    below.set(xlabel="time [s]", xlim=(0, min(FORCE_SECONDS, recording.reading.angle.shape[-1] / RATE_HZ)))


def _draw_trajectory(axes: Any, angle: Any) -> None:
    """Seen as the force's axes lie: at angle 0 the fin points to the left (-x), at positive angles upwards (+y)."""
    assert isinstance(axes, PolarAxes)
    shown = angle[: TRAJECTORY_SECONDS * RATE_HZ]
    axes.set_theta_zero_location("W")
    axes.set_theta_direction(-1)
    widest = max(90, 15 * math.ceil(math.degrees(float(np.abs(shown).max())) / 15))
    axes.set_thetamin(-widest)
    axes.set_thetamax(widest)
    axes.set_thetagrids(range(-90, 91, 30))
    axes.plot(shown, np.arange(1, len(shown) + 1) / RATE_HZ, color=BLACK, linewidth=1.0)
    axes.set_rlim(0, len(shown) / RATE_HZ)
    axes.set_rgrids([1, 2, 3, 4, 5][: len(shown) // RATE_HZ], angle=-widest)
    axes.set_title("fin angle [°], radius: time [s]", loc="center")


def _draw_force(axes: Axes, force: Any, reference: float) -> None:
    shown = force[: FORCE_SECONDS * RATE_HZ]
    time = np.arange(1, len(shown) + 1) / RATE_HZ
    axes.plot(time, shown, color=BLUE, linewidth=0.6, alpha=0.75, label="force")
    average = moving_average(shown[:, None])[:, 0]
    axes.plot(time[WINDOW - 1 :], average, color=BLACK, linestyle="--", linewidth=1.6, label="moving average over 2 s")
    axes.axhline(reference, color=ORANGE, linewidth=1.6, label="reference", zorder=1.9)


def moving_figure(experiments: Sequence[Moving]) -> Figure:
    """Every reference that moves, at its first seed: the moving average beside it, the force, the fin's angle."""
    each = [(moving, index) for moving in experiments for index in range(len(moving.signals))]
    columns = min(len(each), 2)
    rows = math.ceil(len(each) / columns)
    with styled():
        figure = new_figure(6.6 * columns, 0.5 + 5.2 * rows)
        for panel, (moving, index) in zip(figure.subfigures(rows, columns, squeeze=False).flat, each, strict=False):
            _draw_moving(panel, moving, index)
        labelled = {label: handle for axes in figure.get_axes()[:3]
                    for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}  # fmt: skip
        figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=len(labelled))
    return figure


def _draw_moving(panel: SubFigure, moving: Moving, index: int) -> None:
    reading, reference = moving.recording.reading, np.asarray(moving.recording.reference[index])
    force = np.asarray(reading.force[index, 0])
    *averages, forces, angles = panel.subplots(4, 1, sharex=True, height_ratios=(1.3, 1.3, 1, 0.8))
    time = np.arange(1, len(force) + 1) / RATE_HZ
    for axis, axes in enumerate(averages):
        _draw_following(axes, time, moving_average(force)[:, axis], reference[:, axis])
        axes.set(ylabel=f"mean {AXES[axis]} [N]")
    for axis, colour in enumerate((BLUE, GREY)):
        forces.plot(time, force[:, axis], color=colour, linewidth=0.6, label=f"force {AXES[axis]}")
    forces.set(ylabel="force [N]")
    angles.plot(time, np.degrees(reading.angle[index, 0]), color=BLACK, linewidth=0.8)
    angles.set(ylabel="angle [°]", xlabel="time [s]", xlim=(0, time[-1]))
    panel.align_ylabels([*averages, forces, angles])
    settling = moving.settling(index)
    x, y = moving.error[index].mean(axis=0)
    errors = f"error {x:.2f}, {y:.2f} N"
    if settling is not None:
        errors += f"; settles in {settling:.2f} s" if math.isfinite(settling) else "; never settles"
    averages[0].set_title(f"{moving.signals[index]}\n{errors}".replace("-", "\N{MINUS SIGN}"), weight="bold")


def _draw_following(axes: Axes, time: Any, average: Any, reference: Any) -> None:
    """Without the force, whose peaks are several times the reference."""
    late = time[WINDOW - 1 :]
    axes.fill_between(
        time, reference - SETTLED_N, reference + SETTLED_N, step="pre", color=ORANGE, alpha=0.2, linewidth=0,
        label=f"reference ± {SETTLED_N:g} N",
    )  # fmt: skip
    axes.plot(time, reference, color=ORANGE, linewidth=1.6, drawstyle="steps-pre", label="reference")
    axes.plot(late, moving_average(reference[:, None])[:, 0], ":", color=ORANGE, label="its moving average")
    axes.plot(late, average, "--", color=BLACK, linewidth=1.6, label="moving average of the force over 2 s")


def table_two_figure(summaries: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Errors by reference: each controller's ``evaluation.json``, beside the paper's figures where it has them."""
    references = [tuple(row["reference_n"]) for row in next(iter(summaries.values()))["references"]]
    with styled():
        figure = new_figure(10, 5.2)
        for index, (axes, axis) in enumerate(zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)):
            _draw_errors(axes, axis, index, summaries, references)
        axes.set_xticks(
            range(len(references) + 1),
            [f"({x:g}, {y:g})".replace("-", "\N{MINUS SIGN}") for x, y in references] + ["mean"],
        )
        axes.set_xlabel("reference force (x, y) [N]")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def _draw_errors(
    axes: Axes, axis: str, index: int, summaries: Mapping[str, Mapping[str, Any]], references: list[Any]
) -> None:
    bars: list[tuple[str, str, str | None, list[float], Any]] = []
    for name, summary in summaries.items():
        rows = [*(row[axis] for row in summary["references"]), summary["mean"][axis]]
        errors = [row["error_n"] for row in rows]
        intervals = [row["error_interval_n"] for row in rows]
        spread = (
            None if intervals[0] is None else [high - error for (_, high), error in zip(intervals, errors, strict=True)]
        )
        colour = CONTROLLER_COLOURS.get(name, GREY)
        bars.append((name, colour, None, errors, spread))
        published = PAPER_TABLE_II.get(name, {})
        if published and set(references) <= published.keys():
            values = [published[reference][2 * index] for reference in references]
            bars.append((f"{name}, paper (real fin)", colour, "////", [*values, float(np.mean(values))], None))
    width = min(0.25, 0.8 / len(bars))
    places = np.arange(len(references) + 1)
    for k, (label, colour, hatch, values, spread) in enumerate(bars):
        axes.bar(
            places + (k - (len(bars) - 1) / 2) * width, values, 0.92 * width, yerr=spread, label=label, hatch=hatch,
            facecolor="white" if hatch else colour, edgecolor=colour, ecolor=BLACK, capsize=2,
        )  # fmt: skip
    axes.axvline(len(references) - 0.5, color=GREY, linewidth=0.8)
    axes.grid(visible=False, axis="x")
    axes.set_ylabel(f"error {axis} [N]")
