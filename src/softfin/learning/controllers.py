"""Writes trained policies to controller folders, with scores and a figure of the errors during
training."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from softfin.control.store import write_controller
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AnyArray
from softfin.learning.policy import name_policy_arrays
from softfin.learning.train import TrainedPolicies
from softfin.storage.figures import BLUE, new_figure, save_figure, styled
from softfin.storage.run_directory import TRAINING_LOG

Curve = tuple[Sequence[int | float] | np.ndarray, Sequence[int | float] | np.ndarray]
"""Steps and values of a run; the steps increase."""


def learning_curve(entries: Sequence[JsonObject], *names: str) -> Curve:
    """Return the steps, and the mean of the named metrics at each step, from all log entries that
    contain them."""
    having = [entry for entry in entries if names[0] in entry]
    steps = [entry["step"] for entry in having]
    values = [float(np.mean([entry[name] for name in names])) for entry in having]
    return steps, values


def learning_figure(curve: Curve) -> Figure:
    """Plot the error without exploration noise during training."""
    with styled():
        figure = new_figure(7, 3.4)
        axes = figure.subplots()
        axes.plot(*curve, color=BLUE, label="error without exploration noise")
        axes.set(xlabel="environment steps (actions)", ylabel="mean error of both axes [N]")
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.legend()
    return figure


def save_policies(
    path: Path,
    trained: TrainedPolicies,
    provenance: Mapping[str, object],
    learnt: Mapping[str, object],
    overwrite: bool = False,
    extra_files: Callable[[Path], None] = lambda _: None,
) -> None:
    """Write the controller, completely or not at all; `learnt` describes the training data of the
    plant, and `extra_files` writes additional files into the folder."""
    config = trained.config
    policies = trained.policies
    if config.controller == "single":
        # Only the policies of a grid have a leading axis of cells.
        policies = jax.tree.map(lambda leaf: leaf[0], policies)
    arrays = {name: np.asarray(leaf) for name, leaf in name_policy_arrays(policies).items()}
    keys = {
        "cells": [cell.model_dump(mode="json") for cell in trained.cells],
        "task": trained.task.model_dump(mode="json"),
        "reachable": trained.reachable.to_dict(),
        **learnt,
        "policy": config.policy.model_dump(mode="json"),
        "scores": _list_scores(trained),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }

    def write_training(folder: Path) -> None:
        extra_files(folder)
        curve = learning_curve(trained.log, "score_x_n", "score_y_n")
        save_figure(learning_figure(curve), folder / TRAINING_LOG / "learning.png")

    write_controller(
        path,
        config.controller,
        trained.limits,
        keys,
        arrays,
        write_training,
        overwrite,
        trained.task.clock,
    )


def _list_scores(trained: TrainedPolicies) -> list[JsonObject]:
    """List the evaluation references of each cell and the force errors in the training plant.

    Errors are relative to ``tracked_reference_n``, the nearest reachable force.
    ``out_of_distribution_fraction`` is the fraction of actions outside the training data of an
    ensemble.
    """
    rows = []
    outside = trained.evaluation.out_of_distribution_fraction
    for i, cell in enumerate(trained.cells):
        for j, reference in enumerate(cell.lattice(trained.config.lattice)):
            row: JsonObject = {
                "cell": i,
                "reference_n": list(reference),
                "tracked_reference_n": _rounded(trained.references[i, j]),
                "error_n": _rounded(trained.evaluation.error[i, j]),
                "std_n": _rounded(trained.evaluation.std[i, j]),
            }
            if outside is not None:
                row["out_of_distribution_fraction"] = float(outside[i, j])
            rows.append(row)
    return rows


def _rounded(force: AnyArray) -> list[float]:
    # Four significant digits suit fins of any size.
    return [float(f"{float(x):.4g}") for x in force]
