"""Cells of reference forces."""

import jax
import numpy as np
import pytest

from softfin.errors import ConfigurationError
from softfin.tracking.references import PAPER_CELLS, PAPER_RANGE, PAPER_REFERENCES, Cell


def test_each_reference_of_the_paper_is_the_middle_of_its_cell_and_in_no_other() -> None:
    for i, reference in enumerate(PAPER_REFERENCES):
        assert PAPER_CELLS[i].centre == reference
        assert [cell.distance(reference) == 0 for cell in PAPER_CELLS].count(True) == 1
        assert PAPER_RANGE.distance(reference) == 0


def test_references_are_drawn_within_the_cell() -> None:
    cell = Cell(low=(1, -2), high=(3, -1))
    drawn = jax.vmap(cell.references().draw)(jax.random.split(jax.random.key(0), 200))
    assert all(cell.distance((float(x), float(y))) == 0 for x, y in drawn)
    np.testing.assert_allclose(drawn.mean(axis=0), cell.centre, atol=0.2)


def test_the_distance_is_that_to_the_nearest_edge_or_corner() -> None:
    cell = Cell(low=(0, 0), high=(1, 1))
    assert cell.distance((0.5, 3)) == 2
    assert cell.distance((4, 5)) == 5


def test_a_lattice_lies_evenly_within_the_cell() -> None:
    assert PAPER_RANGE.lattice(3) == tuple((x, y) for x in (1.0, 2.0, 3.0) for y in (-1.0, 0.0, 1.0))


def test_a_cell_upside_down_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"low .* is above high .*; give the lower corner first"):
        Cell.build({"low": (1, 0), "high": (0, 1)})
