"""Figures of learning: how a reward grew over training, and how a surrogate follows a log."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.statistics import CONFIDENCE, interval
from softfin.storage.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, styled

Numbers = Sequence[int | float] | np.ndarray

Series = Float[np.ndarray, " points"]

Curve = tuple[Numbers, Numbers]
"""(steps, values) of one run, steps increasing."""

FEW = 2
"""So few runs show their range: the 95% interval of the mean of two is 13 times as wide."""


def learning_figure(runs: Mapping[str, Sequence[Curve]], quantity: str = "mean reward a step") -> Figure:
    """One line a group of runs, such as seeds: their mean, in the band of its 95% interval, over each run in faint."""
    with styled():
        figure = new_figure(7, 3.4)
        axes = figure.subplots()
        bands = []
        for (name, curves), colour, line in zip(
            runs.items(), cycle((BLUE, ORANGE, GREEN, BLACK)), cycle(("-", "--", "-.", ":")), strict=False
        ):
            steps, values = _together(curves)
            label = name
            if len(curves) > 1:
                low, high, what = _band(values)
                label = f"{name}, mean and {what} of {len(curves)}"
                axes.plot(steps, values.T, color=colour, linewidth=0.5, alpha=0.5)
                bands.append((steps, low, high, colour))
            axes.plot(steps, values.mean(axis=0), line, color=colour, label=label)
        # The runs alone set the range of the axis: an interval of few is wide.
        limits = axes.get_ylim()
        for steps, low, high, colour in bands:
            axes.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.set_ylim(limits)
        axes.set(xlabel="environment steps (actions at 3 Hz)", ylabel=quantity)
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.legend()
    return figure


def _together(curves: Sequence[Curve]) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "runs points"]]:
    """On the steps of the first run, as far as all runs go; straight lines between the points of the others."""
    reach = min(steps[-1] for steps, _ in curves)
    steps = np.array([step for step in curves[0][0] if step <= reach], np.float64)
    return steps, np.stack([np.interp(steps, np.asarray(x, float), np.asarray(y, float)) for x, y in curves])


def _band(values: Float[np.ndarray, "runs points"]) -> tuple[Series, Series, str]:
    """Its lower and upper edge, and what it is."""
    if len(values) <= FEW:
        return values.min(axis=0), values.max(axis=0), "range"
    low, high = np.array([interval(column) for column in values.T]).T
    return low, high, f"{CONFIDENCE:.0%} interval"


def prediction_figure(
    measured: Float[np.ndarray, "ticks 2"], predicted: Mapping[str, Float[np.ndarray, "ticks 2"]], start_s: float = 0.0
) -> Figure:
    """Measured force and predictions of it by name, at 100 Hz from `start_s` [s]."""
    time = start_s + np.arange(len(measured)) / RATE_HZ
    with styled():
        figure = new_figure(9, 4.2)
        for index, (axes, axis) in enumerate(zip(figure.subplots(2, 1, sharex=True), AXES, strict=True)):
            axes.plot(time, measured[:, index], color="#BBBBBB", linewidth=2.6, label="measured")
            for (name, force), colour, line in zip(
                predicted.items(), cycle((BLUE, BLACK)), cycle(("-", "--")), strict=False
            ):
                axes.plot(time, force[:, index], line, color=colour, label=name, linewidth=1.1)
            axes.set_ylabel(f"force {axis} [N]")
        last: Any = axes
        last.set(xlabel="time [s]", xlim=(time[0], time[-1]))
        handles, labels = last.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure
