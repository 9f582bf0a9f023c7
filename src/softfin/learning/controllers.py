"""Trained policies as controllers' folders, with their scores."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from softfin.control.store import write_controller
from softfin.learning.configuration import TrainConfig
from softfin.learning.policy import Policy, memory_of, named
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import TrainingResult
from softfin.surrogate.channels import UNKNOWN


def save_controller(
    path: Path,
    trained: TrainingResult,
    seed: int,
    provenance: dict[str, Any],
    extra_files: Callable[[Path], None] | None = None,
    learnt: Mapping[str, Any] = UNKNOWN,
    overwrite: bool = False,
) -> None:
    """Write the controller of one seed, whole or not at all; `extra_files` adds to the folder.

    `learnt` tells what its plant has learnt from (`softfin.surrogate.channels.learnt_from`).
    """
    config, index = trained.config, trained.seeds.index(seed)
    # Those of a grid have a leading axis of cells.
    one = (index, 0) if config.controller == "single" else (index,)
    policies: Policy = jax.tree.map(lambda leaf: np.asarray(leaf)[one], trained.policies)
    reachable = None if trained.force_map is None else trained.force_map.reachable
    keys = {
        "cells": [cell.model_dump(mode="json") for cell in config.cells],
        "task": config.task.model_dump(mode="json"),
        "reachable": None if reachable is None else reachable.to_dict(),
        "switching": config.switching.model_dump(mode="json") if config.controller == "grid" else None,
        **learnt,
        "policy": config.policy.model_dump(mode="json"),
        "memory": memory_of(policies),
        "scores": _scores(config, config.evaluation_references(reachable), trained.evaluation, index),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }
    write_controller(path, config.controller, trained.limits, keys, named(policies), extra_files, overwrite)


def _scores(
    config: TrainConfig, tracked: Float[np.ndarray, "cells references 2"], scored: PolicyEvaluation, index: int
) -> list[dict[str, Any]]:
    """List, for each cell, its references and the force errors in the plant that it was trained in.

    Errors are against ``held_n``, the nearest force that the fin can make, where its reach is known. ``beyond_data`` is
    the share of actions that left the training data of the plant, where that is a surrogate with such a measure.
    """
    rows, outside = [], scored.out_of_distribution_fraction
    for i, cell in enumerate(config.cells):
        for j, reference in enumerate(cell.lattice(config.lattice)):
            forces = {"held_n": tracked[i, j], "error_n": scored.error[index, i, j], "std_n": scored.std[index, i, j]}
            rounded = {name: [round(float(x), 4) for x in force] for name, force in forces.items()}
            beyond = {} if outside is None else {"beyond_data": float(outside[index, i, j])}
            rows.append({"cell": i, "reference_n": list(reference), **rounded, **beyond})
    return rows
