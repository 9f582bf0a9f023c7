"""The error of the policies over the steps of a training run, as a figure in the controller's folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softfin.core.quantities import AXES
from softfin.storage.artifact import write_file
from softfin.storage.curves import Curve, learning_figure
from softfin.storage.figures import render
from softfin.storage.run_directory import LOG, read_log

FIGURE = "learning.svg"
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
        write_file(folder / FIGURE, render(figure, "svg"))


def curves(entries: Sequence[Mapping[str, Any]]) -> list[Curve]:
    """The error of each seed against the steps, where the policies were evaluated."""
    first, second = (f"/score_{axis}_n" for axis in AXES)
    seeds = dict.fromkeys(name.removesuffix(first) for entry in entries for name in entry if name.endswith(first))
    scored = {seed: [entry for entry in entries if entry.get(seed + first) is not None] for seed in seeds}
    return [
        ([entry["step"] for entry in each], [(entry[seed + first] + entry[seed + second]) / 2 for entry in each])
        for seed, each in scored.items()
    ]
