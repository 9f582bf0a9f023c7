"""Cells of reference forces."""

import jax
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable, bounding_box
from softfin.task.references import PAPER_CELLS, PAPER_RANGE, References, divide, stack_references


def test_each_reference_of_the_paper_is_the_middle_of_its_cell_and_in_no_other() -> None:
    for i, reference in enumerate(PAPER_REFERENCES):
        assert PAPER_CELLS[i] == Cell.around(reference)
        assert [cell.distance(reference) == 0 for cell in PAPER_CELLS].count(True) == 1
        assert PAPER_RANGE.distance(reference) == 0


def test_references_are_drawn_within_the_cell() -> None:
    cell = Cell(low=(1, -2), high=(3, -1))
    drawn = jax.vmap(References.of(cell).draw)(jax.random.split(jax.random.key(0), 200))
    assert all(cell.distance((float(x), float(y))) == 0 for x, y in drawn)
    np.testing.assert_allclose(drawn.mean(axis=0), np.mean([cell.low, cell.high], axis=0), atol=0.2)


def test_what_the_fin_cannot_make_is_drawn_at_its_edge() -> None:
    reachable = Reachable(np.array([2, 0], np.float32), np.full(64, 1, np.float32))
    references = References.of(PAPER_RANGE)._replace(reachable=reachable)
    keys = jax.random.split(jax.random.key(0), 200)
    free, drawn = (
        np.asarray(jax.vmap(r.draw)(keys)) for r in (References.of(PAPER_RANGE), references)
    )
    inside = np.hypot(*(free - reachable.centre).T) < 0.99
    np.testing.assert_allclose(drawn[inside], free[inside], atol=1e-6)
    np.testing.assert_allclose(np.hypot(*(drawn[~inside] - reachable.centre).T), 1, atol=0.011)
    assert 0.2 < inside.mean() < 0.5


def test_the_bounding_box_is_round_all_cells() -> None:
    cells = [Cell.around((2, 0)), Cell.around((0, 3), 2.0), Cell.around((1, 1))]
    assert bounding_box(cells) == Cell(low=(-1, -0.5), high=(2.5, 4))
    assert bounding_box(PAPER_CELLS) == PAPER_RANGE


def test_stacked_boxes_are_drawn_from_one_by_one() -> None:
    cells = [Cell.around((2, 0)), Cell.around((0, 3))]
    reachable = Reachable(np.array([1, 1], np.float32), np.full(8, 0.5, np.float32))
    stacked = stack_references(cells, reachable)
    key = jax.random.key(1)
    drawn = jax.vmap(lambda references: references.draw(key))(stacked)
    for i, cell in enumerate(cells):
        alone = References.of(cell)._replace(reachable=reachable).draw(key)
        np.testing.assert_allclose(drawn[i], alone, atol=1e-6)
    assert stack_references(cells).reachable is None


def test_the_distance_is_that_to_the_nearest_edge_or_corner() -> None:
    cell = Cell(low=(0, 0), high=(1, 1))
    assert cell.distance((0.5, 3)) == 2
    assert cell.distance((4, 5)) == 5


def test_a_lattice_lies_evenly_within_the_cell() -> None:
    assert PAPER_RANGE.lattice(3) == tuple(
        (x, y) for x in (1.0, 2.0, 3.0) for y in (-1.0, 0.0, 1.0)
    )


def test_a_cell_upside_down_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"low .* high"):
        Cell.build({"low": (1, 0), "high": (0, 1)})


def test_the_parts_of_a_cell_fill_it_in_order_of_x_then_y() -> None:
    cell = Cell(low=(-0.3, -1), high=(1.7, 2))
    parts = divide(cell, 2, 3)
    assert len(parts) == 6
    assert bounding_box(parts) == cell
    assert parts[0].high == parts[4].low == (0.7, 0.0)
