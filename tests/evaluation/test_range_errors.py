"""Errors over a controller's range, at random references."""

import json

import jax
import numpy as np
import pytest

from softfin.core.errors import CoverageError
from softfin.core.randomness import named_generator
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.range_errors import draw_references, errors_at, random_errors
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.references import PAPER_CELLS
from tests.evaluation.test_moving import Covering
from tests.plants import AnalyticFin

KEY = jax.random.key(0)
DISC = Reachable(np.float32([2, 0]), np.full(64, 1.0, np.float32))


def within(cells_, reachable_=None):
    class Within(Covering):
        cells: tuple[Cell, ...] = cells_
        reachable: Reachable | None = reachable_

    return Within()


def test_they_lie_in_a_cell_and_in_reach_and_are_spread_by_area():
    cells = (Cell(low=(1, -1), high=(2, 1)), Cell(low=(2, 0), high=(3, 1)))
    forces = draw_references(within(cells, DISC), 3000, named_generator(0, "test"))
    assert forces.shape == (3000, 2)
    assert DISC.contains(forces).all()
    assert all(min(cell.distance((x, y)) for cell in cells) == 0 for x, y in forces.tolist())
    # Three quarters of a disc, two of them in the first cell.
    assert np.mean(forces[:, 0] < 2) == pytest.approx(2 / 3, abs=0.03)


def test_the_seed_says_which():
    one, same, other = (
        draw_references(within(PAPER_CELLS), 5, named_generator(seed, "test")) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).all()


def test_cells_beyond_reach_are_refused():
    with pytest.raises(
        CoverageError, match=r"random = 3: this fin can reach only 0 of 300 references .*; train"
    ):
        draw_references(
            within((Cell(low=(5, 5), high=(6, 6)),), DISC), 3, named_generator(0, "test")
        )


def test_the_errors_have_mean_percentile_and_worst():
    row = random_errors(Covering(), AnalyticFin(noise_n=0), 20, 0, 3, KEY)
    references = np.array(row["references_n"])
    assert references.shape == (20, 2)
    alone = errors_at(Covering(), AnalyticFin(noise_n=0), references, 3, KEY)
    np.testing.assert_allclose(row["errors_n"], alone, atol=1e-3)
    for i in range(2):
        assert row["worst_n"][i] == pytest.approx(alone[:, i].max(), abs=1e-3)
        assert row["mean_n"][i] < row["p95_n"][i] < row["worst_n"][i]
    json.dumps(row, allow_nan=False)


def test_each_error_is_that_of_its_reference_alone():
    row = random_errors(Covering(), AnalyticFin(noise_n=0), 20, 0, 3, KEY)
    config = EvaluateConfig(references=(tuple(row["references_n"][7]),), seconds=3)
    alone = score_controller(Covering(), AnalyticFin(noise_n=0), config)
    np.testing.assert_allclose(row["errors_n"][7], alone.scores.error[0, 0], atol=1e-3)
