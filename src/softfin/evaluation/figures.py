"""Draw Matplotlib figures of experiments and errors."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, cast

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke
from matplotlib.projections.polar import PolarAxes

from softfin.core.quantities import AXES, RATE_HZ, TICK_S, AnyArray
from softfin.core.window import moving_average
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.moving_references import MovingScores
from softfin.evaluation.range_errors import ErrorMap
from softfin.gaits.figure import mark_paper_references
from softfin.gaits.reachable import PAPER_REFERENCES, force_decimals
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled, with_minus_signs

TRAJECTORY_SECONDS = 5
FORCE_SECONDS = 10
"""Length of the plots from the start of an experiment [s], as in the paper's evaluation figure."""

ERROR_COLOURS = "Blues"
"""Colour map of the errors: darker means larger, also for colour-blind readers and in greyscale."""


def experiments_figure(recording: ExperimentRecording) -> Figure:
    """Draw the fin's trajectory and the force on both axes for every reference, at the first
    seed."""
    count = len(recording.reference)
    columns = min(count, 2)
    rows = math.ceil(count / columns)
    shown = recording.force[:, 0, : FORCE_SECONDS * RATE_HZ]
    low = np.minimum(shown.min(axis=(0, 1)), recording.reference.min(axis=0))
    high = np.maximum(shown.max(axis=(0, 1)), recording.reference.max(axis=0))
    # Limits that both axes of all panels share, with round numbers.
    unit = 10.0 ** np.floor(np.log10(max(float((high - low).max()), 1e-9) / 4))
    low = np.floor(low / unit) * unit
    high = np.ceil(high / unit) * unit
    with styled():
        figure = new_figure(6.6 * columns, 0.5 + 3.1 * rows)
        panels = figure.subfigures(rows, columns, squeeze=False).flat
        for index in range(count):
            _draw_experiment(panels[index], recording, index, np.stack([low, high], axis=1))
        add_legend(figure, figure.get_axes()[1:2], "outside lower center")
    return figure


def add_legend(
    figure: Figure,
    panels: Iterable[Axes],
    place: Literal["outside lower center", "outside upper center"],
    columns: int | None = None,
) -> None:
    """Add one legend for all panels, with each label once; one row unless `columns` is set."""
    shown: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc=place, ncols=columns or len(shown))


def _draw_experiment(
    panel: SubFigure,
    recording: ExperimentRecording,
    index: int,
    limits: Float[np.ndarray, "axes 2"],
) -> None:
    reference = recording.reference[index]
    grid = panel.add_gridspec(2, 2, width_ratios=(1, 1.7))
    polar = cast(PolarAxes, panel.add_subplot(grid[:, 0], projection="polar"))
    _draw_trajectory(polar, recording.reading.angle[index, 0])
    above = panel.add_subplot(grid[0, 1])
    below = panel.add_subplot(grid[1, 1], sharex=above)
    above.tick_params(labelbottom=False)
    force = np.asarray(recording.force[index, 0, : FORCE_SECONDS * RATE_HZ])
    time = np.arange(1, len(force) + 1) / RATE_HZ
    window = recording.clock.window_ticks
    late = time[window - 1 :]
    average = moving_average(force, window)
    for axis, axes in enumerate((above, below)):
        axes.plot(time, force[:, axis], color=BLUE, linewidth=0.6, alpha=0.75, label="force")
        axes.plot(
            late,
            average[:, axis],
            "--",
            color=BLACK,
            linewidth=1.6,
            label=f"moving average over {window * TICK_S:g} s",
        )
        axes.axhline(
            float(reference[axis]), color=ORANGE, linewidth=1.6, label="reference", zorder=1.9
        )
        low, high = limits[axis]
        # A dead sensor or a still fin may leave no range to draw.
        ylim = (low, high) if high > low else (low - 1, high + 1)
        axes.set(ylabel=f"force {AXES[axis]} [N]", ylim=ylim)
    above.set_title(
        with_minus_signs(f"reference ({reference[0]:g}, {reference[1]:g}) N"), weight="bold"
    )
    below.set(
        xlabel="time [s]", xlim=(0, min(FORCE_SECONDS, recording.reading.angle.shape[-1] / RATE_HZ))
    )


def _draw_trajectory(axes: PolarAxes, angle: Float[AnyArray, " ticks"]) -> None:
    """Draw the angle in the force's axes: at angle 0, the fin points left (-x), and at positive
    angles up (+y)."""
    shown = angle[: TRAJECTORY_SECONDS * RATE_HZ]
    # At least 90 degrees to both sides, more in steps of 15 degrees if the fin moves further.
    widest = max(90, 15 * math.ceil(math.degrees(float(np.abs(shown).max())) / 15))
    axes.set(theta_zero_location="W", theta_direction=-1, thetamin=-widest, thetamax=widest)
    axes.set_thetagrids(range(-90, 91, 30))
    axes.plot(shown, np.arange(1, len(shown) + 1) / RATE_HZ, color=BLACK, linewidth=1.0)
    axes.set_rlim(0, len(shown) / RATE_HZ)
    axes.set_rgrids([1, 2, 3, 4, 5][: len(shown) // RATE_HZ], angle=-widest)
    axes.set_title("fin angle [°], radius: time [s]", loc="center")


def moving_figure(experiments: Sequence[MovingScores]) -> Figure:
    """Draw the moving average, the force and the fin's angle for every moving reference, at the
    first seed."""
    each = [(moving, index) for moving in experiments for index in range(len(moving.rows))]
    columns = min(len(each), 2)
    rows = math.ceil(len(each) / columns)
    with styled():
        figure = new_figure(6.6 * columns, 0.5 + 5.2 * rows)
        panels = figure.subfigures(rows, columns, squeeze=False).flat
        for panel, (moving, index) in zip(panels, each, strict=False):
            _draw_moving(panel, moving, index)
        # Three legend columns fit the width of one panel.
        add_legend(figure, figure.get_axes()[:3], "outside lower center", 3 * columns)
    return figure


def _draw_moving(panel: SubFigure, moving: MovingScores, index: int) -> None:
    recording = moving.recording
    reference = np.asarray(recording.reference[index])
    force = np.asarray(recording.force[index, 0])
    *averages, forces, angles = panel.subplots(4, 1, sharex=True, height_ratios=(1.3, 1.3, 1, 0.8))
    time = np.arange(1, len(force) + 1) / RATE_HZ
    window = recording.clock.window_ticks
    late = time[window - 1 :]
    average = moving_average(force, window)
    asked = moving_average(reference, window)
    # The force has its own panel, because its peaks are several times the reference.
    for axis, axes in enumerate(averages):
        wanted = reference[:, axis]
        axes.fill_between(
            time,
            wanted - moving.settled_n,
            wanted + moving.settled_n,
            step="pre",
            color=ORANGE,
            alpha=0.2,
            linewidth=0,
            label=f"reference ± {moving.settled_n:g} N",
        )
        axes.plot(
            time, wanted, color=ORANGE, linewidth=1.6, drawstyle="steps-pre", label="reference"
        )
        axes.plot(late, asked[:, axis], ":", color=ORANGE, label="its moving average")
        axes.plot(
            late,
            average[:, axis],
            "--",
            color=BLACK,
            linewidth=1.6,
            label=f"moving average of the force over {window * TICK_S:g} s",
        )
        axes.set(ylabel=f"mean {AXES[axis]} [N]")
    for axis, colour in enumerate((BLUE, GREY)):
        forces.plot(time, force[:, axis], color=colour, linewidth=0.6, label=f"force {AXES[axis]}")
    forces.set(ylabel="force [N]")
    angles.plot(time, np.degrees(recording.reading.angle[index, 0]), color=BLACK, linewidth=0.8)
    angles.set(ylabel="angle [°]", xlabel="time [s]", xlim=(0, time[-1]))
    panel.align_ylabels([*averages, forces, angles])
    row = moving.rows[index]
    decimals = force_decimals(float(np.abs(reference).max()))
    errors = f"error {row['x']['error_n']:.{decimals}f}, {row['y']['error_n']:.{decimals}f} N"
    if row["settles"] is not None:
        errors += (
            f"; settles in {row['longest_settling_s']:.2f} s"
            if row["settles"]
            else "; never settles"
        )
    averages[0].set_title(with_minus_signs(f"{row['described']}\n{errors}"), weight="bold")


def error_map_figure(errors: ErrorMap) -> Figure:
    """Draw heat maps of the errors in x and y, with the paper's references and the outline of the
    reachable forces."""
    (left, bottom) = errors.cell.low
    (right, top) = errors.cell.high
    # Rows are y and columns are x; NaN where no reference is tracked.
    lattice = np.full((errors.points, errors.points, 2), np.nan)
    places = (errors.references - (left, bottom)) / (right - left, top - bottom) * errors.points
    # Each reference is the centre of its part, so rounding down gives the index of the part.
    column, row = np.floor(places).astype(int).T
    lattice[row, column] = errors.error
    greatest = float(errors.error.max())
    decimals = force_decimals(max(map(abs, (left, bottom, right, top))))
    with styled():
        figure = new_figure(9.6, 4.6)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for index, (axes, axis) in enumerate(zip(panels, AXES, strict=True)):
            axes.grid(visible=False)
            # Hatched background where the controller does not cover the reference or the fin cannot
            # reach it.
            axes.patch.set(facecolor="white", hatch="////", edgecolor="#CCCCCC")
            image = axes.imshow(
                lattice[..., index],
                origin="lower",
                extent=(left, right, bottom, top),
                vmin=0,
                vmax=greatest,
                cmap=ERROR_COLOURS,
                interpolation="nearest",
            )
            error = errors.error[:, index]
            # On a finer lattice, the numbers would be unreadable.
            if errors.points <= 11:
                for (x, y), value in zip(errors.references, error, strict=True):
                    # A patch in the colour of the map keeps numbers readable over markers.
                    patch = {
                        "facecolor": colormaps[ERROR_COLOURS](value / greatest),
                        "edgecolor": "none",
                        "pad": 0.8,
                    }
                    axes.text(
                        x,
                        y,
                        f"{value:.{decimals}f}",
                        ha="center",
                        va="center",
                        fontsize=7,
                        bbox=patch,
                        color="white" if value > 0.6 * greatest else BLACK,
                    )
            # Fins of other sizes may produce none of them.
            if any(errors.cell.distance(reference) == 0 for reference in PAPER_REFERENCES):
                mark_paper_references(axes, 16)
            if errors.reachable is not None:
                outline = np.concatenate([errors.reachable, errors.reachable[:1]])
                axes.plot(
                    *outline.T,
                    color=BLACK,
                    linestyle="--",
                    linewidth=1.4,
                    label="reachable forces",
                    path_effects=[withStroke(linewidth=3, foreground="white")],
                )
            axes.set_title(
                f"error {axis}: mean {error.mean():#.2g} N, worst {error.max():#.2g} N",
                weight="bold",
            )
            axes.set(xlabel="reference force x [N]", aspect="equal")
        panels[0].set_ylabel("reference force y [N]")
        figure.colorbar(
            image, ax=panels, label="mean |moving average \N{MINUS SIGN} reference| [N]", shrink=0.9
        )
        add_legend(figure, panels[:1], "outside lower center")
    return figure


def held_figure(recording: ExperimentRecording, settled_n: float) -> Figure:
    """Draw the moving average and the reference of each experiment, at the first seed, with both
    axes in one panel, and a band of `settled_n` around the reference."""
    count = len(recording.reference)
    columns = min(count, 2)
    rows = math.ceil(count / columns)
    with styled():
        figure = new_figure(3.1 * columns, 0.6 + 1.3 * rows)
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat[count:]:
            axes.set_visible(False)
        for index, axes in enumerate(panels.flat[:count]):
            window = recording.clock.window_ticks
            average = moving_average(np.asarray(recording.force[index, 0]), window)
            time = np.arange(window, window + len(average)) / RATE_HZ
            for axis, (colour, name) in enumerate(
                ((BLUE, "thrust x, forward"), (ORANGE, "side force y"))
            ):
                asked = float(recording.reference[index, axis])
                axes.axhspan(
                    asked - settled_n, asked + settled_n, color=colour, alpha=0.15, linewidth=0
                )
                axes.axhline(
                    asked,
                    color=BLACK,
                    linestyle="--",
                    linewidth=1,
                    zorder=3,
                    label="target (reference)",
                )
                axes.plot(time, average[:, axis], color=colour, linewidth=1.8, label=name)
            x, y = recording.reference[index]
            axes.set_title(with_minus_signs(f"target: x {x:g} N, y {y:g} N"), weight="bold")
            axes.set_xlim(0, time[-1])
        for axes in panels[-1]:
            axes.set_xlabel("time [s]")
        for axes in panels[:, 0]:
            axes.set_ylabel("mean [N]")
        add_legend(figure, panels[0, :1], "outside upper center")
    return figure
