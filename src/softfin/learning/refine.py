"""Refinement of a grid: the cells with the greatest errors are split, and their parts go on from its policy."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.gaits.reachable import Cell
from softfin.learning.configuration import TrainConfig
from softfin.learning.run import TrainingResult
from softfin.learning.train import train
from softfin.storage.run_directory import RunDirectory
from softfin.task.cells import lattice


def check_refinable(config: TrainConfig, more: int) -> None:
    """Raise ConfigurationError unless the run's grid can have `more` cells more."""
    if more and (config.controller != "grid" or config.algorithm != "gradient"):
        raise ConfigurationError(
            f"--refine {more}: only a grid that is trained by gradients is refined, not {config.controller} by "
            f"{config.algorithm}; leave it out, or give --controller grid --algorithm gradient"
        )
    if not 0 <= more <= 3 * len(config.cells):
        raise ConfigurationError(
            f"--refine {more}: {len(config.cells)} cells are split once, into four each, so 0 .. "
            f"{3 * len(config.cells)} can be added; give as many, or more --cells"
        )


def train_refined(
    plant: Plant, trained: TrainingResult, more: int, run_directory: RunDirectory, progress: Progress | None
) -> tuple[TrainingResult, list[int]]:
    """Train a finer grid, in this process and with the same budget a policy; and the index of each cell's parent.

    No cell ends with a greater error than its parent's policy had in it.
    """
    cells, parents = refine(trained.config.cells, np.asarray(trained.evaluation.error).mean(axis=(0, 2)), more)
    config = trained.config.model_copy(update={"cells": cells})
    start = jax.tree.map(lambda leaf: leaf[:, np.asarray(parents)], trained.policies)
    return train(plant, config, trained.seeds, run_directory, progress, trained.force_map, start), parents


def refine(
    cells: Sequence[Cell], errors: Float[np.ndarray, "cells 2"], more: int
) -> tuple[tuple[Cell, ...], list[int]]:
    """Add up to `more` cells; return all in their order, parts where their cell stood, and the index of each's parent.

    Those with the greatest mean errors [N] are split first, into four each. Where fewer than three are left to add, a
    cell is split in two across the axis of its greater error, as a policy for a shorter range errs less along it.
    """
    parts: list[tuple[Cell, ...]] = [(cell,) for cell in cells]
    for index in np.argsort(-errors.mean(axis=1), kind="stable").tolist():
        if more == 0:
            break
        two = (1, 2) if np.argmax(errors[index]) else (2, 1)
        parts[index] = lattice(*((2, 2) if more >= 3 else two), cells[index])
        more -= len(parts[index]) - 1
    parents = [index for index, part in enumerate(parts) for _ in part]
    return tuple(cell for part in parts for cell in part), parents
