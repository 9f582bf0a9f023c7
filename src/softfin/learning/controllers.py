"""Trained policies as controllers: in memory, and as folders with their scores."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from softfin.control.controller import LoadedController
from softfin.control.store import FORMAT, KIND, build_controller
from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.learning.policy import Policy, memory_of, named
from softfin.learning.run import TrainingResult
from softfin.storage import artifact as artifacts
from softfin.surrogate.channels import UNKNOWN


def controller_of(trained: TrainingResult, seed: int) -> LoadedController:
    """Build the controller that a run trained from one of its seeds."""
    policies = _policies(trained, seed)
    return build_controller(_description(trained), _arrays(policies), f"seed {seed}")


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
    policies = _policies(trained, seed)
    description = {
        **_description(trained),
        **learnt,
        "policy": trained.config.policy.model_dump(mode="json"),
        "memory": memory_of(policies),
        "scores": _scores(trained, trained.seeds.index(seed)),
        "configuration": trained.config.model_dump(mode="json"),
        "provenance": provenance,
    }
    artifacts.save(path, KIND, description, _arrays(policies), extra_files, overwrite)


def _description(trained: TrainingResult) -> dict[str, Any]:
    config = trained.config
    return {
        "kind": KIND,
        "format": FORMAT,
        "controller": config.controller,
        "action_rate_hz": ACTION_RATE_HZ,
        "limits": trained.limits.to_dict(),
        "cells": [cell.model_dump(mode="json") for cell in config.cells],
        "task": config.task.model_dump(mode="json"),
        "reachable": None if trained.force_map is None else trained.force_map.reachable.to_dict(),
        "switching": config.switching.model_dump(mode="json") if config.controller == "grid" else None,
    }


def _policies(trained: TrainingResult, seed: int) -> Policy:
    """Take the policies of a seed: those of a grid with a leading axis of cells, a single one without."""
    index = trained.seeds.index(seed)
    one = (index, 0) if trained.config.controller == "single" else (index,)
    policies: Policy = jax.tree.map(lambda leaf: np.asarray(leaf)[one], trained.policies)
    return policies


def _arrays(policies: Policy) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in named(policies).items()}


def _scores(trained: TrainingResult, index: int) -> list[dict[str, Any]]:
    """List, for each cell, its references and the force errors in the plant that it was trained in.

    Errors are against ``held_n``, the nearest force that the fin can make, where its reach is known. ``beyond_data`` is
    the share of actions that left the data of the plant, where that is a surrogate that knows them.
    """
    scored, tracked, rows = trained.evaluation, trained.evaluation_references(), []
    outside = scored.out_of_distribution_fraction
    for i, cell in enumerate(trained.config.cells):
        for j, reference in enumerate(cell.lattice(trained.config.lattice)):
            error, std = (np.asarray(part)[index, i, j] for part in (scored.error, scored.std))
            data = {} if outside is None else {"beyond_data": float(outside[index, i, j])}
            rows.append(
                {
                    "cell": i,
                    "reference_n": list(reference),
                    "held_n": [round(float(x), 4) for x in tracked[i, j]],
                    "error_n": [round(float(x), 4) for x in error],
                    "std_n": [round(float(x), 4) for x in std],
                    **data,
                }
            )
    return rows
