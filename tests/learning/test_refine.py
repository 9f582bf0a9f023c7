"""Refinement: the worst cells are split, nothing is lost, and the parts begin with their parent's policy."""

from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS
from softfin.learning import train as train_module
from softfin.learning.configuration import GRADIENT_GRID
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import TrainingResult
from softfin.learning.train import check_refinable, refine, train_refined
from softfin.storage.run_directory import RunDirectory
from softfin.task.references import PAPER_RANGE, check_cells, lattice
from tests.plants import AnalyticFin

FOUR = lattice(2, 2, PAPER_RANGE)
ERROR = np.array([[0.1, 0.1], [0.5, 0.2], [0.2, 0.1], [0.1, 0.4]])


def stacked(seeds: int, cells: int) -> Policy:
    one = jax.eval_shape(lambda: Policy.create(jax.random.key(0), PolicyConfig(units=2, width=2), 5))
    places, random = np.arange(seeds * cells, dtype=np.float32).reshape(seeds, cells), np.random.default_rng(0)
    many: Policy = jax.tree.map(lambda x: np.add.outer(places, random.normal(size=x.shape).astype(x.dtype)), one)
    return many


def test_the_worst_cell_is_split_into_four_that_stand_in_its_place() -> None:
    cells, parents = refine(FOUR, ERROR, 3)
    assert parents == [0, 1, 1, 1, 1, 2, 3]
    assert cells[1:5] == lattice(2, 2, FOUR[1])
    assert cells[0] == FOUR[0]


def test_what_is_left_of_the_budget_splits_in_two_across_the_axis_of_the_greater_error() -> None:
    cells, parents = refine(FOUR, ERROR, 5)
    assert parents == [0, 1, 1, 1, 1, 2, 2, 3, 3]
    assert cells[-2:] == lattice(1, 2, FOUR[3])
    assert cells[5:7] == lattice(2, 1, FOUR[2])


def test_a_cell_whose_error_is_no_number_counts_as_the_worst() -> None:
    error = ERROR.copy()
    error[2] = np.inf
    assert refine(FOUR, error, 3)[1] == [0, 1, 2, 2, 2, 2, 3]


@settings(deadline=None, max_examples=30)
@given(more=st.integers(1, 12), errors=st.lists(st.floats(0.01, 2), min_size=12, max_size=12))
def test_a_finer_grid_covers_the_same_references_once(more: int, errors: list[float]) -> None:
    cells = lattice(3, 2, PAPER_RANGE)
    refined, parents = refine(cells, np.reshape(errors, (6, 2)), more)
    check_cells(refined, False, "refined")
    assert len(refined) == len(cells) + more
    for cell, parent in zip(refined, parents, strict=True):
        assert cells[parent].distance(cell.low) == cells[parent].distance(cell.high) == 0


def test_each_part_begins_with_its_parents_policy_seed_by_seed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    policies, config = stacked(2, 4), GRADIENT_GRID.model_copy(update={"cells": FOUR})
    error = np.stack([ERROR, ERROR])[:, :, None]
    trained = TrainingResult(config, PAPER_LIMITS, (0, 1), policies, PolicyEvaluation(error, error))
    monkeypatch.setattr(train_module, "train", lambda *given: (given[-1], trained.evaluation))
    space = RunDirectory(tmp_path / "out", {})
    handed, parents = train_refined(AnalyticFin(), trained, 3, space, None)
    assert parents == [0, 1, 1, 1, 1, 2, 3]
    kernel, before = np.asarray(handed.policies.net.lstm.kernel), np.asarray(policies.net.lstm.kernel)
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
