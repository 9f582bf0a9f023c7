"""Cells of a grid: lattices and files; every area and overlap is found and said where."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.gaits.reachable import Cell, bounding_box
from softfin.task.references import (
    PAPER_CELLS,
    PAPER_RANGE,
    area,
    check_apart,
    check_cells,
    lattice,
    parse_cells,
    parse_range,
)

QUARTERS = lattice(2, 2, PAPER_RANGE)


def file_of(tmp_path: Path, text: str) -> str:
    path = tmp_path / "cells.yaml"
    path.write_text(text)
    return str(path)


@settings(deadline=None, max_examples=30)
@given(
    columns=st.integers(1, 9),
    rows=st.integers(1, 9),
    x=st.floats(-5, 5),
    y=st.floats(-5, 5),
    width=st.floats(0.1, 7),
    height=st.floats(0.1, 7),
)
def test_a_lattice_fills_its_range_without_gap_or_overlap(
    columns: int, rows: int, x: float, y: float, width: float, height: float
) -> None:
    within = Cell(low=(x, y), high=(x + width, y + height))
    cells = parse_cells(f"{columns}x{rows}", within)
    assert len(cells) == columns * rows
    np.testing.assert_allclose(
        [bounding_box(cells).low, bounding_box(cells).high], [within.low, within.high]
    )
    check_cells(cells, False, "lattice")


def test_columns_lie_along_x_and_rows_along_y() -> None:
    cells = parse_cells("3x1", PAPER_RANGE)
    assert [cell.low for cell in cells] == [(0.5, -1.5), (1.5, -1.5), (2.5, -1.5)]
    assert {cell.high[1] for cell in cells} == {1.5}


def test_paper_is_the_six_cells_round_the_papers_references() -> None:
    assert parse_cells("paper", Cell(low=(0, 0), high=(9, 9))) == PAPER_CELLS


def test_the_papers_cells_touch_and_leave_a_third_of_their_bounding_box() -> None:
    assert area(bounding_box(PAPER_CELLS)) - sum(map(area, PAPER_CELLS)) == pytest.approx(3.0)
    check_cells(PAPER_CELLS, True, "paper")


@pytest.mark.parametrize("missing", [4, 7], ids=["left", "right"])
def test_a_missing_cell_is_refused_with_its_size(missing: int) -> None:
    cells = lattice(4, 3, PAPER_RANGE)
    with pytest.raises(
        ConfigurationError, match=r"grid: the cells leave 0.75 N\^2 of their bounding box"
    ):
        check_cells([cell for cell in cells if cell != cells[missing]], False, "grid")


def test_a_file_gives_its_cells_in_their_order(tmp_path: Path) -> None:
    text = "cells:\n  - {low: [1, -1], high: [3, 1]}\n  - {low: [0, -1], high: [1, 1]}\n"
    cells = parse_cells(file_of(tmp_path, text), PAPER_RANGE)
    assert cells == (Cell(low=(1, -1), high=(3, 1)), Cell(low=(0, -1), high=(1, 1)))


def test_a_file_may_leave_gaps_where_it_says_so(tmp_path: Path) -> None:
    text = "cells: [{low: [0, 0], high: [1, 1]}, {low: [2, 0], high: [3, 1]}]\n"
    assert len(parse_cells(file_of(tmp_path, text + "allow_gaps: true\n"), PAPER_RANGE)) == 2
    with pytest.raises(
        ConfigurationError,
        match=r"cells.yaml: the cells leave 1 N\^2 of their bounding box \(x 0 .. 3, y 0 .. 1 N\) "
        r"uncovered; add "
        r"cells there, or set allow_gaps: true",
    ):
        parse_cells(file_of(tmp_path, text), PAPER_RANGE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "cells: [{low: [0, 0], high: [2, 1]}, {low: [2, 0], high: [3, 1]}, {low: [1.5, 0], "
            "high: [2, 3]}]",
            r"cells 1 \(x 0 .. 2, y 0 .. 1 N\) and 3 \(x 1.5 .. 2, y 0 .. 3 N\) overlap in x 1.5 "
            r".. 2, y 0 .. 1 N; ",
        ),
        ("cells: []", r"no cells; add at least one \{low: \[x, y\], high: \[x, y\]\}"),
        (
            "cells: [{low: [0, 0], high: [0, 1]}]",
            r"cell 1 \(x 0 .. 0, y 0 .. 1 N\) has no width in x; use a lower and a higher force",
        ),
        ("cells: [{low: [0, 0], high: [-1, 1]}]", "low .* must not be greater than high"),
        ("cells: [{low: [.nan, 0], high: [1, 1]}]", r"cells.0.low.0.* = nan: .* finite"),
        ("cells: [{low: [0, 0], high: [1, .inf]}]", r"cells.0.high.1.* = inf: .* finite"),
        ("cells: [{low: [0], high: [1, 1]}]", r"cells.0.low.1"),
        ("cells: [{lower: [0, 0], high: [1, 1]}]", r"cells.0"),
        ("boxes: []", "cells"),
        ("cells: [", "not valid YAML"),
        ("- {low: [0, 0], high: [1, 1]}", "contains a list; it must be a mapping"),
    ],
)
def test_a_file_that_is_no_grid_is_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        parse_cells(file_of(tmp_path, text), PAPER_RANGE)
    assert "cells.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0x3", "--cells 0x3: 0 cells; use 1 to 1024 cells, at least one along each axis"),
        ("99x99", "--cells 99x99: 9801 cells"),
        ("3x", "--cells 3x: must be paper, a grid such as 3x3 .* or a .yaml file"),
        ("-1x3", "--cells -1x3: must be paper, a grid such as 3x3"),
        ("", "--cells : must be paper, a grid such as 3x3"),
        ("nowhere.yaml", "nowhere.yaml: cannot be read"),
    ],
)
def test_what_is_neither_lattice_nor_file_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_cells(text, PAPER_RANGE)


def test_a_lattice_over_a_line_is_refused() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"--cells 2x2: the range \(x 0 .. 1, y 1 .. 1 N\) has no width in y",
    ):
        parse_cells("2x2", Cell(low=(0, 1), high=(1, 1)))


def test_a_range_is_four_numbers() -> None:
    assert parse_range("0.5, -1.5,3.5,1.5") == PAPER_RANGE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3", "--range 1,2,3: must be paper or four numbers X0,Y0,X1,Y1"),
        ("1,2,3,x", "must be paper or four numbers"),
        ("nan,0,1,1", "--range nan,0,1,1: low.0.* = nan: .* finite"),
        ("2,0,1,1", "--range 2,0,1,1: low .* must not be greater than high"),
    ],
)
def test_what_is_no_range_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_range(text)


def test_touching_cells_do_not_overlap() -> None:
    check_apart(QUARTERS, "quarters")
    with pytest.raises(
        ConfigurationError, match=re.escape(f"overlap in {QUARTERS[0]}; move an edge")
    ):
        check_apart([QUARTERS[0], PAPER_RANGE], "both")
