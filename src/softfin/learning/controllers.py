"""Writes trained policies to controller folders, with their scores and a figure of the errors
during training."""

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.control.policy import GAITS
from softfin.control.store import write_controller
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AXES, AnyArray
from softfin.learning.configuration import TrainConfig
from softfin.learning.policy import Policy, name_policy_arrays, policy_memory
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import TrainingResult
from softfin.storage.figures import BLACK, BLUE, GREEN, ORANGE, new_figure, save_figure, styled
from softfin.storage.run_directory import LOG, read_training_log
from softfin.surrogate.channels import UNKNOWN

Curve = tuple[Sequence[int | float] | np.ndarray, Sequence[int | float] | np.ndarray]
"""(steps, values) of a run, with increasing steps."""

REFINED = "refined"
"""Folder of the logs of a refinement, which is a separate run with steps from 0."""


def write_learning(folder: Path) -> None:
    """Write ``learning.svg`` next to the logs of a run and its tasks, with a curve for each seed in
    each log."""
    runs: dict[str, list[Curve]] = {}
    for log in sorted(folder.rglob(LOG)):
        is_refined = REFINED in log.relative_to(folder).parts
        group = "refined cells" if is_refined else "error without exploration noise"
        runs.setdefault(group, []).extend(curves(read_training_log(log)))
    # A run that stopped before its first evaluation has no curve.
    found = {group: group_curves for group, group_curves in runs.items() if group_curves}
    if found:
        figure = learning_figure(found, "mean error of both axes [N]")
        save_figure(figure, folder, "learning", ("svg",))


def curves(entries: Sequence[JsonObject]) -> list[Curve]:
    """Return the error of each seed over the steps, for the entries of a log with an evaluation."""
    first = f"/score_{AXES[0]}_n"
    second = f"/score_{AXES[1]}_n"
    scored = [entry for entry in entries if any(name.endswith(first) for name in entry)]
    if not scored:
        return []
    seeds = [name.removesuffix(first) for name in scored[0] if name.endswith(first)]
    steps = [entry["step"] for entry in scored]
    seed_curves: list[Curve] = []
    for seed in seeds:
        errors = [(entry[seed + first] + entry[seed + second]) / 2 for entry in scored]
        seed_curves.append((steps, errors))
    return seed_curves


def learning_figure(runs: Mapping[str, Sequence[Curve]], quantity: str) -> Figure:
    """Plot the mean of each group of runs, with the individual runs as thinner lines."""
    styles = zip(cycle((BLUE, ORANGE, GREEN, BLACK)), cycle(("-", "--", "-.", ":")), strict=False)
    with styled():
        figure = new_figure(7, 3.4)
        axes = figure.subplots()
        for (name, curves), (colour, line) in zip(runs.items(), styles, strict=False):
            # At the steps of the first run, up to the end of the shortest run.
            reach = min(steps[-1] for steps, _ in curves)
            steps = [step for step in curves[0][0] if step <= reach]
            values = np.stack([np.interp(steps, *curve) for curve in curves])
            if len(curves) > 1:
                axes.plot(steps, values.T, color=colour, linewidth=0.5, alpha=0.5)
                name = f"{name}, mean of {len(curves)}"
            axes.plot(steps, values.mean(axis=0), line, color=colour, label=name)
        axes.set(xlabel="environment steps (actions)", ylabel=quantity)
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.legend()
    return figure


def save_controller(
    path: Path,
    trained: TrainingResult,
    seed: int,
    provenance: Mapping[str, object],
    extra_files: Callable[[Path], None] | None = None,
    learnt: Mapping[str, object] = UNKNOWN,
    overwrite: bool = False,
) -> None:
    """Write the controller of a seed, completely or not at all; `learnt` describes the training
    data of its plant."""
    config = trained.config
    index = trained.seeds.index(seed)
    # The policies of a grid have a leading axis of cells.
    is_grid = config.controller == "grid"
    one = (index,) if is_grid else (index, 0)
    policies: Policy = jax.tree.map(lambda leaf: np.asarray(leaf)[one], trained.policies)
    reachable = trained.reachable
    tracked = config.evaluation_references(reachable)
    keys = {
        "cells": [cell.model_dump(mode="json") for cell in config.cells],
        "task": config.task.model_dump(mode="json"),
        "reachable": None if reachable is None else reachable.to_dict(),
        "switching": config.switching.model_dump(mode="json") if is_grid else None,
        **learnt,
        "policy": config.policy.model_dump(mode="json"),
        "memory": policy_memory(policies),
        "scores": _scores(config, tracked, trained.evaluation, index),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }
    arrays = name_policy_arrays(policies)
    if is_grid:
        # All policies have the same gaits, which are stored once.
        for name, array in arrays.items():
            if name.startswith(f"{GAITS}."):
                arrays[name] = array[0]
    write_controller(
        path,
        config.controller,
        trained.limits,
        keys,
        arrays,
        extra_files,
        overwrite,
        config.task.clock,
    )


def _scores(
    config: TrainConfig,
    tracked: Float[np.ndarray, "cells references 2"],
    scored: PolicyEvaluation,
    index: int,
) -> list[JsonObject]:
    """List the evaluation references of each cell and the force errors in the training plant.

    Errors are relative to ``tracked_reference_n``, the nearest reachable force if the reachable
    region is known. ``out_of_distribution_fraction`` is the fraction of actions outside the
    training data of an ensemble.
    """
    rows = []
    outside = scored.out_of_distribution_fraction
    for i, cell in enumerate(config.cells):
        for j, reference in enumerate(cell.lattice(config.lattice)):
            row: JsonObject = {
                "cell": i,
                "reference_n": list(reference),
                "tracked_reference_n": _rounded(tracked[i, j]),
                "error_n": _rounded(scored.error[index, i, j]),
                "std_n": _rounded(scored.std[index, i, j]),
            }
            if outside is not None:
                row["out_of_distribution_fraction"] = float(outside[index, i, j])
            rows.append(row)
    return rows


def _rounded(force: AnyArray) -> list[float]:
    # Four significant digits, for fins of any size.
    return [float(f"{float(x):.4g}") for x in force]
