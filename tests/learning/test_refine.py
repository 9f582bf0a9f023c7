"""Refinement: the worst cells are split, nothing is lost, and the parts begin with their parent's policy."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.learning.configuration import GRADIENT_GRID
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.refine import check_refinable, inherited, refine
from softfin.task.references import PAPER_RANGE, check_cells, lattice

FOUR = lattice(2, 2, PAPER_RANGE)
ERROR = np.array([[0.1, 0.1], [0.5, 0.2], [0.2, 0.1], [0.1, 0.4]])


def stacked(seeds: int, cells: int) -> Policy:
    one = jax.eval_shape(lambda: Policy.create(jax.random.key(0), PolicyConfig(units=2, width=2), 5))
    places, random = np.arange(seeds * cells, dtype=np.float32).reshape(seeds, cells), np.random.default_rng(0)
    many: Policy = jax.tree.map(lambda x: np.add.outer(places, random.normal(size=x.shape).astype(x.dtype)), one)
    return many


def test_the_worst_cell_is_split_into_four_that_stand_in_its_place() -> None:
    refined = refine(FOUR, ERROR, 3)
    assert refined.parents == (0, 1, 1, 1, 1, 2, 3)
    assert refined.cells[1:5] == lattice(2, 2, FOUR[1])
    assert refined.cells[0] == FOUR[0]


def test_what_is_left_of_the_budget_splits_in_two_across_the_axis_of_the_greater_error() -> None:
    refined = refine(FOUR, ERROR, 5)
    assert refined.parents == (0, 1, 1, 1, 1, 2, 2, 3, 3)
    assert refined.cells[-2:] == lattice(1, 2, FOUR[3])
    assert refined.cells[5:7] == lattice(2, 1, FOUR[2])


def test_a_cell_whose_error_is_no_number_counts_as_the_worst() -> None:
    error = ERROR.copy()
    error[2] = np.inf
    assert refine(FOUR, error, 3).parents == (0, 1, 2, 2, 2, 2, 3)


@settings(deadline=None, max_examples=30)
@given(more=st.integers(1, 12), errors=st.lists(st.floats(0.01, 2), min_size=12, max_size=12))
def test_a_finer_grid_covers_the_same_references_once(more: int, errors: list[float]) -> None:
    cells = lattice(3, 2, PAPER_RANGE)
    refined = refine(cells, np.reshape(errors, (6, 2)), more)
    check_cells(refined.cells, False, "refined")
    assert len(refined.cells) == len(cells) + more
    for cell, parent in zip(refined.cells, refined.parents, strict=True):
        assert cells[parent].distance(cell.low) == cells[parent].distance(cell.high) == 0


def test_each_part_begins_with_its_parents_policy_seed_by_seed() -> None:
    policies = stacked(2, 4)
    handed = inherited(policies, refine(FOUR, ERROR, 3).parents)
    kernel, before = np.asarray(handed.net.lstm.kernel), np.asarray(policies.net.lstm.kernel)
    assert kernel.shape[:2] == (2, 7)
    for seed in range(2):
        for child, parent in enumerate((0, 1, 1, 1, 1, 2, 3)):
            np.testing.assert_array_equal(kernel[seed, child], before[seed, parent])


def test_more_cells_than_splitting_each_once_gives_are_refused() -> None:
    check_refinable(GRADIENT_GRID, 18)
    with pytest.raises(
        ConfigurationError, match=r"--refine 19: 6 cells are split once, into four each, so 0 .. 18 can"
    ):
        check_refinable(GRADIENT_GRID, 19)
