"""What a controller admits: its cells, and within them what the fin can make."""

import dataclasses

import numpy as np
import pytest

from softfin.control.references import check_within, resolve_reference
from softfin.core.errors import CoverageError
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.references import PAPER_CELLS

BOX = Cell(low=(0, -2), high=(3, 2))
DISC = Reachable(np.array([1, 0], np.float32), np.full(360, 1.5, np.float32))


@dataclasses.dataclass
class Holder:
    """Of a controller, what is looked at here."""

    reachable: Reachable | None
    cells: tuple[Cell, ...] = (BOX,)

    def init(self):
        raise AssertionError("it is not moved")

    def act(self, state, measured, reference):
        raise AssertionError("it is not moved")

    def check(self, reference):
        check_within(self.cells, reference)


def test_a_reference_within_reach_is_held_as_it_is():
    for strict in (False, True):
        assert resolve_reference(Holder(DISC), (2, 1), strict) == ((2, 1), None)


def test_beyond_reach_the_nearest_force_is_held_and_both_are_named():
    (x, y), warning = resolve_reference(Holder(DISC), (3, 0), False)
    assert (x, y) == pytest.approx((2.5, 0), abs=1e-3)
    assert "(3, 0) N" in (warning or "")
    assert "(2.500, " in (warning or "")
    assert "\n" not in (warning or "")


def test_strictly_it_is_refused_with_the_way_out():
    with pytest.raises(CoverageError, match=r"\(3, 0\) N: .* \(2\.500, .* --strict"):
        resolve_reference(Holder(DISC), (3, 0), True)


def test_what_a_controller_was_not_trained_for_is_refused_whatever_the_fin_can_do():
    with pytest.raises(CoverageError, match=r"\(-0\.3, 0\) N: 0\.3 N outside"):
        resolve_reference(Holder(DISC), (-0.3, 0), False)
    with pytest.raises(CoverageError, match="outside"):
        resolve_reference(Holder(None), (5, 0), False)


def test_where_the_reach_is_not_known_all_that_was_trained_for_is_resolve_reference():
    assert resolve_reference(Holder(None), (3, 2), True) == ((3, 2), None)


def test_a_force_on_a_cells_edge_is_within_and_the_nearest_of_many_is_named():
    check_within(PAPER_CELLS, (0.5, 1.5))
    with pytest.raises(CoverageError, match=r"0\.5 N .* \(x 2\.5 \.\. 3\.5, y -0\.5 \.\. 0\.5 N\)"):
        check_within(PAPER_CELLS, (4, 0))


def test_an_edge_in_single_precision_is_still_the_edge():
    cell = Cell(low=(0.1, -0.3), high=(2.3, 0.7))
    for x, y in np.float32([cell.low, cell.high]).tolist():
        check_within((cell,), (x, y))
    with pytest.raises(CoverageError, match="outside"):
        check_within((cell,), (2.301, 0))


def test_a_reference_of_ones_own_cells_is_held_where_they_meet_the_reach():
    weak = Holder(Reachable(np.float32([1, 0]), np.full(360, 0.8, np.float32)), (PAPER_CELLS[1],))
    (x, y), warning = resolve_reference(weak, (1.6, -1.4), False)
    # The plain nearest force, (1.32, -0.74), would be left of the cell.
    assert (x, y) == pytest.approx((1.5, -np.sqrt(0.8**2 - 0.5**2)), abs=2e-3)
    assert warning is not None


def test_cells_that_the_reach_does_not_meet_are_named_with_the_force_asked_for():
    small = Holder(Reachable(np.float32([1, 0]), np.full(360, 0.45, np.float32)), PAPER_CELLS)
    for reference in ((1, -1), (2, 0), (2, 1)):
        named = rf"\({reference[0]}, {reference[1]}\) N: .*softfin map"
        with pytest.raises(CoverageError, match=named):
            resolve_reference(small, reference, False)


def test_a_cell_that_is_a_line_has_its_nearest_force_on_the_line():
    line = Holder(DISC, (Cell(low=(0, 0.5), high=(5, 0.5)),))
    held, _ = resolve_reference(line, (4, 0.5), False)
    assert held == pytest.approx((1 + np.sqrt(2), 0.5), abs=2e-3)


def test_what_is_not_a_force_is_refused():
    with pytest.raises(CoverageError, match=r"\(nan, 0\) N"):
        resolve_reference(Holder(None), (float("nan"), 0.0), False)
