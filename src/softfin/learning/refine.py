"""Refinement of a grid: the cells with the greatest errors are split, and the parts go on from their parent's policy.

trained cells, their errors -> refine -> finer cells, each with its parent -> train, from the parents' policies
"""

from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float

from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import AnyArray
from softfin.gaits.reachable import Cell
from softfin.learning.configuration import TrainConfig
from softfin.learning.policy import Policy
from softfin.learning.run import TrainingResult
from softfin.learning.train import train
from softfin.storage.run_directory import RunDirectory
from softfin.task.references import lattice


class RefinedGrid(NamedTuple):
    """A finer grid."""

    cells: tuple[Cell, ...]
    """Cells in their order; the parts of a cell stand where it stood."""
    parents: tuple[int, ...]
    """For each cell, the index of the cell that it is, or is a part of."""


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
) -> tuple[TrainingResult, tuple[int, ...]]:
    """Train a finer grid, in this process and with the same budget a policy; and the parent of each cell.

    No cell ends with a greater error than its parent's policy had in it.
    """
    finer = refine(trained.config.cells, np.asarray(trained.evaluation.error).mean(axis=(0, 2)), more)
    config, start = trained.config.model_copy(update={"cells": finer.cells}), inherited(trained.policies, finer.parents)
    return train(plant, config, trained.seeds, run_directory, progress, trained.force_map, start), finer.parents


def inherited(policies: Policy, parents: Sequence[int]) -> Policy:
    """Policies with leaves ``(seeds, cells, ...)``, each cell of a finer grid with that of its parent."""
    return cast(Policy, jax.tree.map(lambda leaf: leaf[:, np.asarray(parents)], policies))


def refine(cells: Sequence[Cell], error: Float[AnyArray, "cells 2"], more: int) -> RefinedGrid:
    """Add up to `more` cells: those with the greatest mean errors [N] are split first, into four each.

    Where fewer than three are left to add, a cell is split in two across the axis of its greater error, because a
    policy for a shorter range of references has smaller errors along it.
    """
    errors = np.asarray(error)
    parts: list[tuple[Cell, ...]] = [(cell,) for cell in cells]
    for index in np.argsort(-errors.mean(axis=1), kind="stable").tolist():
        if more == 0:
            break
        across_x = int(np.argmax(errors[index])) == 0
        columns, rows = (2, 2) if more >= 3 else (2, 1) if across_x else (1, 2)
        parts[index] = lattice(columns, rows, cells[index])
        more -= len(parts[index]) - 1
    parents = tuple(index for index, part in enumerate(parts) for _ in part)
    return RefinedGrid(tuple(cell for part in parts for cell in part), parents)
