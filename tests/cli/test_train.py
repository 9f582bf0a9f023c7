"""``softfin train``: which references its options ask for."""

from pathlib import Path

import numpy as np
import pytest

from softfin.cli.controllers import TrainArguments, asked_cells, asked_seeds
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.force_map import MapConfig, save_map
from softfin.gaits.reachable import Cell, bounding_box
from softfin.task.references import PAPER_CELLS
from tests.gaits.test_map_store import KNOWN


def test_a_lattice_fills_the_range() -> None:
    cells = asked_cells("grid", "3x2", "-1,-2,2,2")
    assert cells is not None
    assert len(cells) == 6
    assert bounding_box(cells) == Cell(low=(-1, -2), high=(2, 2))


def test_a_single_controller_and_gaits_take_the_range_as_their_one_cell() -> None:
    for controller in ("single", "gaits"):
        assert asked_cells(controller, None, "0,0,1,2") == (Cell(low=(0, 0), high=(1, 2)),)
        assert asked_cells(controller, None, None) is None


def test_without_options_the_configuration_stands_and_paper_is_its_default() -> None:
    assert asked_cells("grid", None, None) is None
    assert asked_cells("grid", "paper", None) == PAPER_CELLS


@pytest.mark.parametrize(
    ("controller", "cells", "span", "message"),
    [
        (
            "single",
            "3x3",
            None,
            "--cells 3x3: single has no cells; use --range, or --controller grid",
        ),
        (
            "grid",
            None,
            "0,0,1,1",
            r"--range 0,0,1,1: the cells \(paper\) have fixed positions \(x 0.5 .. 3.5",
        ),
        ("grid", "0x3", None, "--cells 0x3: 0 cells"),
        ("grid", "3x3", "0,0,nan,1", "--range 0,0,nan,1: high.0"),
    ],
)
def test_what_does_not_go_together_is_refused(
    controller: str, cells: str, span: str, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        asked_cells(controller, cells, span)


def test_a_range_of_map_is_the_box_round_all_that_the_fin_can_make(tmp_path: Path) -> None:
    save_map(tmp_path / "map", KNOWN, MapConfig(), PAPER_LIMITS, {})
    low, high = KNOWN.reachable.bounds()
    (cell,) = asked_cells("single", None, "map", tmp_path / "map") or ()
    np.testing.assert_allclose([cell.low, cell.high], [low, high], atol=1e-4)


def test_a_range_of_map_needs_the_map() -> None:
    with pytest.raises(ConfigurationError, match="--range map: requires a map; add --map DIR"):
        TrainArguments(surrogate="tank", out=Path("out"), range="map").check()


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
