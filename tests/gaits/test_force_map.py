"""The map: what was seen, less what no gait holds."""

import re

import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.gaits.force_map import (
    RAY_PARTS,
    MapConfig,
    find_force_map,
    held_region,
    star_warning,
)
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Cell, Reachable
from softfin.gaits.search import GaitConfig
from tests.gaits.mapped import FIN, WITHIN, mapped, surveyed
from tests.plants import StrokeFin

WIDE = Reachable(np.zeros(2, np.float32), np.full(32, 2, np.float32))


def found(lattice: GaitTable, missed: np.ndarray) -> GaitSearchResult:
    """Gaits that miss by so much, all of them in -x."""
    table = lattice
    force = table.references() - np.stack([missed, np.zeros_like(missed)], axis=-1)
    return GaitSearchResult(table, force.astype(np.float32), np.zeros_like(force, np.float32))


def east_misses(lattice: GaitTable) -> GaitSearchResult:
    """By as much as the nodes lie beyond x = 1 N."""
    return found(lattice, np.maximum(lattice.references()[..., 0] - 1, 0))


def test_where_all_gaits_hold_the_region_is_what_was_seen() -> None:
    lattice = GaitTable.empty((-2, -2), (2, 2), (5, 5))
    np.testing.assert_allclose(
        held_region(WIDE, found(lattice, np.zeros((5, 5))), 0.1).corners(), WIDE.corners()
    )


def test_where_gaits_miss_the_region_ends() -> None:
    lattice = GaitTable.empty((-2, -2), (2, 2), (9, 9))
    left = held_region(WIDE, east_misses(lattice), 0.1)
    part = 2 / RAY_PARTS
    assert 1.1 - part - 1e-5 <= left.radius[0] <= 1.1
    np.testing.assert_allclose(left.radius[16], 2)
    corners = left.corners()
    assert corners[:, 0].max() <= 1.1 + 1e-5
    assert left.area() < WIDE.area()


def test_a_wider_tolerance_leaves_more_of_it() -> None:
    lattice = GaitTable.empty((-2, -2), (2, 2), (9, 9))
    areas = [
        held_region(WIDE, east_misses(lattice), tolerance).area() for tolerance in (0.05, 0.3, 2.0)
    ]
    assert areas == sorted(areas)
    assert areas[2] == pytest.approx(WIDE.area(), rel=1e-5)


def test_a_gap_on_the_way_ends_the_ray_though_gaits_beyond_it_hold() -> None:
    lattice = GaitTable.empty((-2, -2), (2, 2), (9, 9))
    missed = np.zeros((9, 9))
    missed[6] = 1
    assert held_region(WIDE, found(lattice, missed), 0.1).radius[0] < 0.7


def test_beyond_the_lattice_the_survey_is_believed() -> None:
    lattice = GaitTable.empty((-0.5, -0.5), (0.5, 0.5), (2, 2))
    np.testing.assert_allclose(held_region(WIDE, found(lattice, np.zeros((2, 2))), 0.1).radius, 2)


def test_a_lattice_of_a_single_force_is_read_without_warnings() -> None:
    lattice = GaitTable.over(Cell(low=(1, 0), high=(1, 0)), 0.5)
    np.testing.assert_allclose(held_region(WIDE, found(lattice, np.zeros((2, 2))), 0.1).radius, 2)


def test_without_a_box_the_lattice_covers_all_that_was_seen() -> None:
    region = Reachable(np.array([1.1, 0], np.float32), np.array([2, 1, 1, 1], np.float32))
    lattice = MapConfig(spacing_n=0.5).empty_table(region)
    np.testing.assert_allclose([lattice.low, lattice.high], [[0.1, -1], [3.1, 1]], atol=1e-6)
    assert lattice.nodes == (7, 5)
    assert MapConfig(box=Cell.around((1, 1)), spacing_n=0.5).empty_table(region).nodes == (3, 3)


def test_the_map_of_a_fin_says_what_it_can_make() -> None:
    reachable = mapped().reachable
    assert reachable.contains((1.5, 0.5))
    assert reachable.contains((2, 0))
    assert not reachable.contains((-0.5, 0))
    assert reachable.area() <= surveyed().reachable.area() + 1e-5


def test_progress_of_both_parts_rises_to_the_end() -> None:
    said: list[tuple[float, str]] = []
    quick = WITHIN.model_copy(update={"gaits": GaitConfig(cycles=2, steps=1)})
    find_force_map(FIN, quick, lambda done, note: said.append((done, note)))
    done = [part for part, _ in said]
    assert done == sorted(done)
    assert done[-1] == pytest.approx(1)
    assert any("gaits" in note for _, note in said)
    assert any("error" in note for _, note in said)


def test_a_fin_without_thrust_has_nothing_to_map() -> None:
    with pytest.raises(PlantError, match=r"no gradient with respect to its commands.*softfin fit"):
        find_force_map(StrokeFin(gain=0.0), MapConfig())


def cloud(lattice: GaitTable, held: np.ndarray) -> GaitSearchResult:
    """Gaits that make exactly the forces of the nodes that are `held`, and miss the others by
    far."""
    return found(lattice, np.where(held, 0.0, 1.0))


FINE = GaitTable.empty((-2, -2), (2, 2), (17, 17))
LENGTH = np.linalg.norm(FINE.references(), axis=-1)
RING = (LENGTH > 1.0) & (LENGTH < 2.0)


def test_forces_that_a_star_leaves_out_are_counted_and_warned_of() -> None:
    gaits = cloud(FINE, RING)
    warning = star_warning(ForceMap(gaits, held_region(WIDE, gaits, 0.1)), 0.1)
    assert re.search(
        r": (100|[3-9]\d)% of the forces that gaits produce are outside", warning or ""
    )


def test_forces_within_a_star_that_no_gait_makes_are_counted_and_warned_of() -> None:
    gaits = cloud(FINE, RING)
    warning = star_warning(ForceMap(gaits, WIDE), 0.1)
    assert re.search(r"no gait was found for 2[2-8]%", warning or "")


def test_of_a_disc_there_is_nothing_to_warn_of() -> None:
    gaits = cloud(FINE, LENGTH < 1.5)
    region = held_region(WIDE, gaits, 0.1)
    np.testing.assert_array_equal(region.centre, WIDE.centre)
    assert star_warning(ForceMap(gaits, region), 0.1) is None
