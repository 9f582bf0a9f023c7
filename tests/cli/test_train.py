"""``softfin train``: which references its options ask for."""

from pathlib import Path

import numpy as np
import pytest

from softfin.cli.controllers import (
    TrainArguments,
    asked_cells,
    asked_range,
    asked_seeds,
    missed_targets,
)
from softfin.core.errors import ConfigurationError
from softfin.gaits.reachable import Cell, Reachable, bounding_box
from softfin.task.references import PAPER_CELLS, PAPER_RANGE

REACH = Cell(low=(0, -2), high=(4, 2))


def test_a_lattice_fills_the_range_or_else_the_reach() -> None:
    within = Cell(low=(-1, -2), high=(2, 2))
    for asked, filled in ((within, within), (None, REACH)):
        cells = asked_cells("grid", "3x2", asked, REACH) or ()
        assert len(cells) == 6
        assert bounding_box(cells) == filled


def test_a_lattice_has_no_cell_that_the_fin_cannot_reach() -> None:
    corners = np.zeros(8, np.float32)
    # A thin region along the diagonals of the first and third quadrants.
    corners[[1, 5]] = 2
    region = Reachable(np.array([2, 0], np.float32), corners + 0.01)
    cells = asked_cells("grid", "2x2", None, REACH, region) or ()
    assert [cell.low for cell in cells] == [(0, -2), (2, 0)]
    none = Reachable(np.array([90, 0], np.float32), np.full(8, 1, np.float32))
    assert len(asked_cells("grid", "2x2", None, REACH, none) or ()) == 4


def test_a_grid_over_a_range_has_six_cells() -> None:
    within = Cell(low=(0, 0), high=(1, 2))
    cells = asked_cells("grid", None, within, REACH) or ()
    assert len(cells) == 6
    assert bounding_box(cells) == within


def test_a_single_controller_takes_the_range_as_its_one_cell() -> None:
    within = Cell(low=(0, 0), high=(1, 2))
    assert asked_cells("single", None, within, REACH) == (within,)


def test_without_options_the_cells_are_those_of_preset_or_file() -> None:
    for controller in ("single", "grid"):
        assert asked_cells(controller, None, None, REACH) is None
    assert asked_cells("grid", "paper", None, REACH) == PAPER_CELLS


def test_a_range_is_the_papers_or_numbers_or_all_that_the_fin_can_make() -> None:
    assert asked_range("paper") == PAPER_RANGE
    assert asked_range("0,0,1,2") == Cell(low=(0, 0), high=(1, 2))
    assert asked_range("map") is asked_range(None) is None


@pytest.mark.parametrize(
    ("cells", "within", "message"),
    [
        (
            "paper",
            Cell(low=(0, 0), high=(1, 1)),
            r"--range x 0 .. 1, y 0 .. 1 N: the cells \(paper\) have fixed positions \(x 0.5 ",
        ),
        ("0x3", None, "--cells 0x3: 0 cells"),
    ],
)
def test_what_does_not_go_together_is_refused(
    cells: str, within: Cell | None, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        asked_cells("grid", cells, within, REACH)


def test_cells_without_a_grid_are_refused_before_anything_is_computed() -> None:
    with pytest.raises(ConfigurationError, match="--cells 3x3: single has no cells; use --range"):
        TrainArguments(surrogate="tank", out=Path("out"), cells="3x3").check()


def test_a_range_that_is_not_four_numbers_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"--range 0,0,nan,1: high\.0"):
        asked_range("0,0,nan,1")


def test_seeds_are_a_number_or_a_list() -> None:
    assert asked_seeds(4, None) == (4,)
    assert asked_seeds(4, "3") == (4, 5, 6)
    assert asked_seeds(0, "0,7,2") == (0, 7, 2)


@pytest.mark.parametrize(
    ("first", "text", "message"),
    [
        (0, "few", "--seeds few: not a count or a list; use e.g. --seeds 3"),
        (0, "0", "--seeds 0: must be one or more"),
        (1, "0,1", "--seed 1: cannot be combined with the list --seeds=0,1"),
        (0, "1,-1", "--seeds 1,-1: must be one or more whole numbers from 0"),
    ],
)
def test_seeds_that_are_none_are_refused(first: int, text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        asked_seeds(first, text)


def test_a_controller_that_misses_its_targets_is_not_written_without_a_warning() -> None:
    near = {"error_n": [0.01, 0.02], "tracked_reference_n": [0.2, 0.1]}
    far = {"error_n": [0.2, 0.2], "tracked_reference_n": [0.2, 0.1]}
    assert missed_targets([near, near]) == []
    (warning,) = missed_targets([near, far, far])
    assert warning.startswith("warning: the errors are 88% of the target forces")


def test_gaits_of_a_map_have_their_own_clock(tmp_path: Path) -> None:
    words = TrainArguments(
        surrogate="tank", out=tmp_path / "x", controller="gaits", map=tmp_path, clock="6,1"
    )
    with pytest.raises(ConfigurationError, match=r"--clock 6,1: the gaits of --map have a clock"):
        words.check()
