"""The error of the policies over the steps of a training run, as a figure in the controller's folder."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.core.quantities import AXES
from softfin.core.window import CONFIDENCE, interval
from softfin.storage.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, save_figure, styled
from softfin.storage.run_directory import LOG, read_log

Series = Float[np.ndarray, " points"]

Curve = tuple[Sequence[int | float] | np.ndarray, Sequence[int | float] | np.ndarray]
"""(steps, values) of one run, steps increasing."""

FEW = 2
"""Number of runs up to which their range is drawn: the 95% interval of the mean of two is 13 times as wide."""

REFINED, SHARED = "refined", "shared"
"""Folders of the logs of a refinement, and of the training of one policy for all cells."""
GROUPS = {REFINED: "refined cells", SHARED: "one policy for all cells"}
"""Runs of their own, which count their steps from 0, by the folder of their logs."""


def write_learning(folder: Path) -> None:
    """Draw ``learning.svg`` beside the logs of a run and of its jobs, a curve for every seed of each log."""
    runs: dict[str, list[Curve]] = {}
    for log in sorted(folder.rglob(LOG)):
        within = [GROUPS[part] for part in log.relative_to(folder).parts if part in GROUPS]
        group = within[-1] if within else "error without exploration noise"
        runs.setdefault(group, []).extend(curves(read_log(log)))
    if found := {group: each for group, each in runs.items() if each}:
        figure = learning_figure(found, "mean error of both axes [N]")
        save_figure(figure, folder, "learning", ("svg",))


def curves(entries: Sequence[Mapping[str, Any]]) -> list[Curve]:
    """The error of each seed against the steps, where the policies were evaluated."""
    first, second = (f"/score_{axis}_n" for axis in AXES)
    seeds = dict.fromkeys(name.removesuffix(first) for entry in entries for name in entry if name.endswith(first))
    scored = {seed: [entry for entry in entries if entry.get(seed + first) is not None] for seed in seeds}
    return [
        ([entry["step"] for entry in each], [(entry[seed + first] + entry[seed + second]) / 2 for entry in each])
        for seed, each in scored.items()
    ]


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
    """Runs on the steps of the first, as far as all go, interpolated linearly."""
    reach = min(steps[-1] for steps, _ in curves)
    steps = np.array([step for step in curves[0][0] if step <= reach], np.float64)
    return steps, np.stack([np.interp(steps, np.asarray(x, float), np.asarray(y, float)) for x, y in curves])


def _band(
    values: Float[np.ndarray, "runs points"],
) -> tuple[Series, Series, str]:
    """Lower and upper edge of the band, and what it is."""
    if len(values) <= FEW:
        return values.min(axis=0), values.max(axis=0), "range"
    low, high = np.array([interval(column) for column in values.T]).T
    return low, high, f"{CONFIDENCE:.0%} interval"
