"""Refinement of a grid: the cells whose policies err most are split, and the parts begin with their parent's policy.

trained cells, their errors -> refine -> finer cells, whose part each is -> inherited -> policies to begin from
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from softfin.core.errors import ConfigurationError
from softfin.core.quantities import AnyArray
from softfin.gaits.reachable import Cell
from softfin.learning.policy import Policy

Lanes = TypeVar("Lanes")


class Refined(NamedTuple):
    """A finer grid."""

    cells: tuple[Cell, ...]
    """The parts of a cell stand where it stood."""
    parents: tuple[int, ...]
    """Of each cell, the index of the one that it is, or is a part of."""


def refine(cells: Sequence[Cell], error: Float[AnyArray, "cells 2"], more: int, tolerance_n: float = 0.0) -> Refined:
    """Up to `more` cells more: of those whose mean error is above the tolerance the worst first, into four each.

    Where fewer than three are left to give, a cell is split in two across the axis of its greater error [N], because
    a policy for a shorter stretch of references errs less along it.
    """
    if more < 1:
        raise ConfigurationError(f"--refine {more}: no cells to add; give 1 or more")
    errors = np.asarray(error)
    parts: list[tuple[Cell, ...]] = [(cell,) for cell in cells]
    for index in np.argsort(-errors.mean(axis=1), kind="stable").tolist():
        if more == 0 or not errors[index].mean() > tolerance_n:
            break
        axes = (0, 1) if more >= 3 else (int(np.argmax(errors[index])),)
        parts[index] = split(cells[index], axes)
        more -= len(parts[index]) - 1
    parents = tuple(index for index, part in enumerate(parts) for _ in part)
    return Refined(tuple(cell for part in parts for cell in part), parents)


def split(cell: Cell, axes: Sequence[int]) -> tuple[Cell, ...]:
    """The halves of a cell along each of the axes (0 is x, 1 is y)."""
    found = [cell]
    for axis in axes:
        found = [half for whole in found for half in _halves(whole, axis)]
    return tuple(found)


def cell_errors(error: Float[AnyArray, "seeds cells references 2"]) -> Float[np.ndarray, "cells 2"]:
    """Of each cell, the mean over seeds and references of a score's errors [N]."""
    mean: Float[np.ndarray, "cells 2"] = np.asarray(error).mean(axis=(0, 2))
    return mean


def inherited(policies: Policy, parents: Sequence[int]) -> Policy:
    """Policies with leaves ``(seeds, cells, ...)``, handed on to the cells of a finer grid."""
    order = np.asarray(parents)
    handed: Policy = jax.tree.map(lambda leaf: leaf[:, order], policies)
    return handed


def begun_from(lanes: Lanes, policies: Policy) -> Lanes:
    """Lanes of any algorithm, one a seed and cell, that go on from policies with leaves ``(seeds, cells, ...)``."""

    def policy_of(lanes: Any) -> Any:
        return lanes.policy

    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), policies)
    begun: Lanes = eqx.tree_at(policy_of, lanes, flat)
    return begun


def _halves(cell: Cell, axis: int) -> tuple[Cell, Cell]:
    middle, low, high = cell.centre[axis], list(cell.low), list(cell.high)
    high[axis] = low[axis] = middle
    return Cell(low=cell.low, high=(high[0], high[1])), Cell(low=(low[0], low[1]), high=cell.high)
