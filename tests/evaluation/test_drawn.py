"""References at random over what a controller was trained for and its fin can make."""

import json

import jax
import numpy as np
import pytest

from softfin.core.errors import CoverageError
from softfin.core.randomness import generator_of
from softfin.evaluation.drawn import draw, hold_drawn
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.references import PAPER_CELLS
from tests.evaluation.test_moving import Covering
from tests.plants import AnalyticFin

DISC = Reachable(np.float32([2, 0]), np.full(64, 1.0, np.float32))


def test_they_lie_in_a_cell_and_in_reach_and_are_spread_by_area():
    cells = (Cell(low=(1, -1), high=(2, 1)), Cell(low=(2, 0), high=(3, 1)))
    drawn = draw(cells, DISC, 3000, generator_of(0, "test"))
    assert drawn.shape == (3000, 2)
    assert DISC.contains(drawn).all()
    assert all(min(cell.distance((x, y)) for cell in cells) == 0 for x, y in drawn.tolist())
    # Three quarters of a disc, two of them in the first cell.
    assert np.mean(drawn[:, 0] < 2) == pytest.approx(2 / 3, abs=0.03)


def test_the_seed_says_which():
    one, same, other = (draw(PAPER_CELLS, None, 5, generator_of(seed, "test")) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).all()


def test_cells_beyond_reach_are_refused():
    with pytest.raises(CoverageError, match=r"random = 3: of 300 references .* this fin can make 0; train"):
        draw((Cell(low=(5, 5), high=(6, 6)),), DISC, 3, generator_of(0, "test"))


def test_the_errors_have_mean_percentile_and_worst():
    drawn = hold_drawn(Covering(), AnalyticFin(), 20, 0, 3, jax.random.key(0))
    described = drawn.to_dict()
    assert described["count"] == len(drawn.error) == 20
    for i, axis in enumerate("xy"):
        assert described[axis]["worst_n"] == drawn.error[:, i].max()
        assert described[axis]["mean_n"] < described[axis]["p95_n"] < described[axis]["worst_n"]
    json.dumps(described, allow_nan=False)
