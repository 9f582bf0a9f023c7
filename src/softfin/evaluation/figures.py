"""Draws Matplotlib figures of experiments and errors."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, cast

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.projections.polar import PolarAxes

from softfin.core.printable import with_minus_signs
from softfin.core.quantities import AXES, RATE_HZ, TICK_S, AnyArray
from softfin.core.window import moving_average
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.fin_figure import draw_fin
from softfin.evaluation.frequency_response import ResponseRow
from softfin.evaluation.headline import settling_time
from softfin.evaluation.moving_references import MovingScores
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled

TRAJECTORY_SECONDS = 5
FORCE_SECONDS = 10
"""Plotted time from the start of an experiment [s], as in the evaluation figure of the paper."""


def experiments_figure(
    recording: ExperimentRecording,
    titles: Sequence[str] = (),
    seconds: int = FORCE_SECONDS,
) -> Figure:
    """Draw the trajectory of the fin and the force on both axes for every reference at the first
    seed, up to `seconds` [s]."""
    count = len(recording.reference)
    columns = min(count, 2)
    rows = math.ceil(count / columns)
    shown = recording.force[:, 0, : seconds * RATE_HZ]
    # (references, 1 or ticks, 2)
    reference = np.asarray(recording.reference).reshape(count, -1, 2)[:, : seconds * RATE_HZ]
    both = np.concatenate([np.asarray(shown), reference], axis=1)
    limits = _round_limits(both.min(axis=(0, 1)), both.max(axis=(0, 1)))
    with styled():
        figure = new_figure(6.6 * columns, 0.5 + 3.1 * rows)
        panels = figure.subfigures(rows, columns, squeeze=False).flat
        for index in range(count):
            x, y = reference[index, 0]
            title = titles[index] if titles else f"reference ({x:g}, {y:g}) N"
            angle = recording.reading.angle[index, 0]
            polar, *forces = _experiment_axes(panels[index], title)
            _draw_trajectory(polar, angle)
            _draw_force(forces, shown[index], reference[index], recording.clock.window_ticks)
            for axes, axis, ylim in zip(forces, AXES, limits, strict=True):
                axes.set(ylabel=f"force {axis} [N]", ylim=ylim)
            forces[1].set(xlabel="time [s]", xlim=(0, len(shown[index]) / RATE_HZ))
        add_legend(figure, figure.get_axes()[1:2], "outside lower center")
    return figure


def fin_figure(recording: ExperimentRecording) -> Figure:
    """Draw the fin with its forces at the end of the first experiment, and its stroke in grey. The
    shape is unknown, so the fin is drawn as a straight line of length 1."""
    window = recording.clock.window_ticks
    angle = np.asarray(recording.reading.angle[0, 0, -window:])
    force = np.asarray(recording.force[0, 0, -window:])
    target = np.reshape(recording.reference[0], (-1, 2))[-1]
    tips = np.stack([-np.cos(angle), np.sin(angle)], axis=1)[:: -window // 10]
    stroke = np.stack([0 * tips, tips])
    forces = np.stack([force[-1], force.mean(axis=0), target])
    with styled():
        figure = new_figure(3.5, 3.4)
        axes = figure.subplots()
        axes.plot(stroke[..., 0], stroke[..., 1], color=GREY, alpha=0.2, linewidth=7)
        draw_fin(axes, stroke[:, 0], forces, scale_n=float(np.abs(forces).max()))
        axes.axis("off")
        axes.set_title(with_minus_signs("target force ({:g}, {:g}) N".format(*target)))
        add_legend(figure, [axes], "outside lower center")
    return figure


def moving_figure(moving: MovingScores) -> Figure:
    """Draw the experiments with moving references, including errors and settling times."""
    titles = []
    for row in moving.rows():
        x, y = (row[axis]["error_n"] for axis in ("x", "y"))
        title = f"{row['described']}\nerror {x:#.2g}, {y:#.2g} N"
        if settling := settling_time(row):
            title += f"; settling time: {settling}"
        titles.append(title)
    return experiments_figure(moving.recording, titles, moving.plan.seconds)


def response_figure(motions: dict[str, list[ResponseRow]]) -> Figure:
    """Draw the gain of the mean force, and the phase of the force without the averaging."""
    with styled():
        figure = new_figure(6.6, 2.8)
        gain, phase = figure.subplots(1, 2)
        for (name, rows), colour in zip(motions.items(), (BLUE, ORANGE), strict=True):
            rates = [row["rate_hz"] for row in rows]
            gain.plot(rates, [row["gain"] for row in rows], "o-", color=colour, label=name)
            lags = {
                row["rate_hz"]: row["force_phase_deg"]
                for row in rows
                if row["force_phase_deg"] is not None
            }
            unwrapped = np.unwrap(list(lags.values()), period=360)
            phase.plot(list(lags), unwrapped, "o-", color=colour)
        window_gain = [row["window_gain"] for row in rows]
        gain.plot(rates, window_gain, "--", color=GREY, label="window alone")
        gain.set(ylabel="gain of the mean force [-]", ylim=(0, None))
        phase.set(ylabel="phase of the force [deg]")
        for axes in (gain, phase):
            axes.set(xscale="log", xlabel="rate of the reference [Hz]")
        gain.legend()
    return figure


def _round_limits(low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, "axes 2"]:
    """Return round limits that all panels share."""
    unit = 10.0 ** np.floor(np.log10(max(float((high - low).max()), 1e-9) / 4))
    low = np.floor(low / unit) * unit
    high = np.ceil(high / unit) * unit
    # A dead sensor or a still fin may leave no range to draw.
    empty = high <= low
    return np.stack([low - empty, high + empty], axis=1)


def add_legend(
    figure: Figure,
    panels: Iterable[Axes],
    place: Literal["outside lower center", "outside upper center"],
) -> None:
    """Add one legend for all panels, with each label once."""
    shown: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc=place, ncols=len(shown))


def _experiment_axes(panel: SubFigure, title: str) -> tuple[PolarAxes, Axes, Axes]:
    grid = panel.add_gridspec(2, 2, width_ratios=(1, 1.7))
    polar = cast(PolarAxes, panel.add_subplot(grid[:, 0], projection="polar"))
    above = panel.add_subplot(grid[0, 1])
    below = panel.add_subplot(grid[1, 1], sharex=above)
    above.tick_params(labelbottom=False)
    above.set_title(with_minus_signs(title), weight="bold")
    return polar, above, below


def _draw_force(
    panels: Sequence[Axes],
    force: Float[AnyArray, "ticks 2"],
    reference: Float[np.ndarray, "rows 2"],
    window: int,
) -> None:
    """Draw each axis of a force with its moving average and reference."""
    time = np.arange(1, len(force) + 1) / RATE_HZ
    average = moving_average(np.asarray(force), window)
    wanted = np.broadcast_to(reference, (len(force), 2))
    label = f"moving average over {window * TICK_S:g} s"
    for axis, axes in enumerate(panels):
        axes.plot(time, force[:, axis], color=BLUE, linewidth=0.6, alpha=0.75, label="force")
        axes.plot(
            time[window - 1 :], average[:, axis], "--", color=BLACK, linewidth=1.6, label=label
        )
        axes.plot(
            time,
            wanted[:, axis],
            color=ORANGE,
            linewidth=1.6,
            drawstyle="steps-pre",
            label="reference",
            zorder=1.9,
        )


def _draw_trajectory(axes: PolarAxes, angle: Float[AnyArray, " ticks"]) -> None:
    """Draw the angle in the axes of the force: at angle 0, the fin points left (-x), and at
    positive angles, it points up (+y)."""
    shown = angle[: TRAJECTORY_SECONDS * RATE_HZ]
    # Show at least 90 degrees to both sides, and more in steps of 15 degrees if the fin moves
    # further.
    widest = max(90, 15 * math.ceil(math.degrees(float(np.abs(shown).max())) / 15))
    axes.set(theta_zero_location="W", theta_direction=-1, thetamin=-widest, thetamax=widest)
    axes.set_thetagrids(range(-90, 91, 30))
    axes.plot(shown, np.arange(1, len(shown) + 1) / RATE_HZ, color=BLACK, linewidth=1.0)
    axes.set_rlim(0, len(shown) / RATE_HZ)
    axes.set_rgrids([1, 2, 3, 4, 5][: len(shown) // RATE_HZ], angle=-widest)
    axes.set_title("fin angle [°], radius: time [s]", loc="center")
