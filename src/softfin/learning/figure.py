"""The error of the policies over the steps of a training run, as a figure in the controller's folder."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from softfin.core.quantities import AXES
from softfin.storage.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, save_figure, styled
from softfin.storage.run_directory import LOG, read_log

Curve = tuple[Sequence[int | float] | np.ndarray, Sequence[int | float] | np.ndarray]
"""(steps, values) of one run, steps increasing."""

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


def learning_figure(runs: Mapping[str, Sequence[Curve]], quantity: str) -> Figure:
    """One line a group of runs, such as seeds: their mean, over each run in faint."""
    styles = zip(cycle((BLUE, ORANGE, GREEN, BLACK)), cycle(("-", "--", "-.", ":")), strict=False)
    with styled():
        figure = new_figure(7, 3.4)
        axes = figure.subplots()
        for (name, curves), (colour, line) in zip(runs.items(), styles, strict=False):
            # On the steps of the first run, as far as all go.
            reach = min(steps[-1] for steps, _ in curves)
            steps = [step for step in curves[0][0] if step <= reach]
            values = np.stack([np.interp(steps, *curve) for curve in curves])
            if len(curves) > 1:
                axes.plot(steps, values.T, color=colour, linewidth=0.5, alpha=0.5)
                name = f"{name}, mean of {len(curves)}"
            axes.plot(steps, values.mean(axis=0), line, color=colour, label=name)
        axes.set(xlabel="environment steps (actions at 3 Hz)", ylabel=quantity)
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.legend()
    return figure
