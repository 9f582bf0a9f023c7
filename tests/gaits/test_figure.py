"""The figure of a map shows the region, the nodes that are held and those that are not."""

from pathlib import Path

import numpy as np
import pytest

from softfin.gaits.figure import map_figure
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import PAPER_REFERENCES, Reachable
from softfin.storage.figures import save_figure
from tests.gaits.known import KNOWN, save_known


def with_missed(*nodes: tuple[int, int]):
    force = KNOWN.gaits.force.copy()
    for node in nodes:
        force[node] += 1
    return KNOWN._replace(gaits=KNOWN.gaits._replace(force=force))


def drawn(known, tolerance_n=0.1):
    """The lines by their labels, the axes, and that of the colours."""
    axes, colours = map_figure(known, tolerance_n).get_axes()
    return (
        {line.get_label(): np.stack(line.get_data(), axis=1) for line in axes.get_lines()},
        axes,
        colours,
    )


def test_region_nodes_and_references_stand_where_they_are():
    lines, axes, colours = drawn(with_missed((0, 0), (2, 3)))
    outline = lines["edge of the reachable region"]
    np.testing.assert_allclose(outline[:-1], KNOWN.reachable.corners())
    np.testing.assert_array_equal(outline[0], outline[-1])
    assert len(lines["a gait produces this force"]) == 10
    np.testing.assert_allclose(lines["no gait found for this force"], [(0.5, -1), (2.5, 2)])
    np.testing.assert_allclose(lines["the paper's references"], PAPER_REFERENCES)
    assert "[N]" in axes.get_xlabel()
    assert "[N]" in axes.get_ylabel()
    assert "[N]" in colours.get_ylabel()


def test_where_all_are_held_no_cross_is_explained():
    assert "no gait found for this force" not in drawn(KNOWN)[0]


def test_the_tolerance_says_what_is_held():
    assert len(drawn(KNOWN, 0.001)[0]["no gait found for this force"]) == 12


def test_everything_is_within_the_frame():
    _, axes, _ = drawn(KNOWN)
    points = np.concatenate(
        [KNOWN.reachable.corners(), KNOWN.gaits.table.references().reshape(-1, 2)]
    )
    for low_high, values in zip((axes.get_xlim(), axes.get_ylim()), points.T, strict=True):
        assert low_high[0] < values.min()
        assert values.max() < low_high[1]


def test_the_frame_and_the_marks_suit_a_small_fin():
    reachable = Reachable(*(np.float32(0.05) * part for part in KNOWN.reachable))
    table = KNOWN.gaits.table
    small = table._replace(low=0.05 * table.low, high=0.05 * table.high)
    lines, axes, _ = drawn(ForceMap(KNOWN.gaits._replace(table=small), reachable))
    assert "the paper's references" not in lines
    box = reachable.bounding_box()
    low, high = box.low, box.high
    margin = 0.2 * reachable.size
    assert axes.get_xlim() == pytest.approx((low[0] - margin, high[0] + margin))


def test_a_fin_whose_gaits_cost_all_the_same_is_drawn_too(tmp_path):
    flat = KNOWN._replace(gaits=KNOWN.gaits._replace(smoothness=np.zeros((3, 4, 2), np.float32)))
    save_figure(map_figure(flat, 0.1), tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_the_folder_holds_the_figure_and_it_does_not_change(tmp_path: Path):
    for name in ("a", "b"):
        save_known(tmp_path / name)
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == ["controller.json", "map.png", "weights.safetensors"]
    assert (tmp_path / "a" / "map.png").read_bytes() == (tmp_path / "b" / "map.png").read_bytes()
