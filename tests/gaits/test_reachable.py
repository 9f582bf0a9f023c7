"""The region of reachable forces: against brute force on its polygon."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.gaits.reachable import Reachable, directions

FORCES = st.tuples(st.floats(-6, 6), st.floats(-6, 6))
REGIONS = st.builds(
    lambda centre, radius: Reachable(np.array(centre, np.float32), np.array(radius, np.float32)),
    st.tuples(st.floats(-2, 2, width=32), st.floats(-2, 2, width=32)),
    st.lists(st.floats(0.25, 4, width=32), min_size=3, max_size=9),
)
SQUARE = Reachable(np.array([1, -1], np.float32), np.full(4, 2, np.float32))
"""On its corner: (3, -1), (1, 1), (-1, -1), (1, -3)."""

projected = jax.jit(lambda region, force: region.project(force))


def sides(region: Reachable) -> tuple[np.ndarray, np.ndarray]:
    a = region.corners().astype(float)
    return a, np.roll(a, -1, axis=0)


def holds(region: Reachable, force: tuple[float, float]) -> bool:
    """By how often a line from the force to infinity crosses the polygon."""
    (ax, ay), (bx, by) = (points.T for points in sides(region))
    x, y = force
    crosses = (ay > y) != (by > y)
    at = ax + (y - ay) / np.where(crosses, by - ay, 1) * (bx - ax)
    return bool((crosses & (at > x)).sum() % 2)


def first_crossing(region: Reachable, force: tuple[float, float]) -> np.ndarray:
    """Where the line from the centre through the force leaves the polygon: every side is tried."""
    centre = np.asarray(region.centre, float)
    offset = np.subtract(force, centre)
    found = []
    for a, b in zip(*sides(region), strict=True):
        matrix = np.stack([offset, a - b], axis=1)
        if abs(np.linalg.det(matrix)) > 1e-9:
            reach, along = np.linalg.solve(matrix, a - centre)
            if reach > 0 and -1e-6 <= along <= 1 + 1e-6:
                found.append(reach)
    return np.asarray(centre + offset * min(found))


@given(REGIONS, FORCES)
@settings(deadline=None, max_examples=100)
def test_a_force_is_projected_to_where_its_line_to_the_centre_meets_the_polygon(region, force):
    if np.hypot(*np.subtract(force, region.centre)) < 1e-2:
        return
    edge = first_crossing(region, force)
    beyond = np.hypot(*np.subtract(force, region.centre)) > np.hypot(*(edge - region.centre))
    np.testing.assert_allclose(
        projected(region, jnp.asarray(force, jnp.float32)), edge if beyond else force, atol=2e-4
    )


@given(REGIONS, FORCES)
@settings(deadline=None, max_examples=40)
def test_it_holds_what_lies_within_the_polygon(region, force):
    a, b = sides(region)
    along = np.linspace(0, 1, 2001)[:, None, None]
    apart = np.hypot(*(a + along * (b - a) - force).reshape(-1, 2).T).min()
    if apart > 5e-3:
        assert region.contains(force) == holds(region, force)


@given(REGIONS, FORCES)
@settings(deadline=None, max_examples=40)
def test_the_nearest_force_is_the_force_itself_or_the_nearest_of_many_on_the_edge(region, force):
    nearest = region.nearest(force)
    if holds(region, force):
        np.testing.assert_allclose(nearest, force, atol=1e-4)
        return
    a, b = sides(region)
    edge = (a + np.linspace(0, 1, 4001)[:, None, None] * (b - a)).reshape(-1, 2)
    apart = np.hypot(*(edge - force).T).min()
    assert np.hypot(*np.subtract(nearest, force)) == pytest.approx(apart, abs=2e-3)
    assert np.hypot(*(edge - nearest).T).min() < 2e-3


def test_the_centre_stays_where_it_is():
    np.testing.assert_array_equal(projected(SQUARE, SQUARE.centre), SQUARE.centre)
    assert SQUARE.nearest((1.0, -1.0)).tolist() == [1.0, -1.0]


def test_a_sector_without_any_width_holds_nothing_but_the_centre():
    """Two neighbouring corners at the centre: nothing was ever made between these directions."""
    region = Reachable(np.zeros(2, np.float32), np.array([0, 0, 1, 1], np.float32))
    assert not region.contains((0.5, 0.5))
    np.testing.assert_allclose(projected(region, jnp.array([0.5, 0.5])), 0, atol=1e-6)
    assert region.contains((-0.4, -0.4))


def test_what_lies_a_little_beyond_the_edge_counts_within_the_tolerance():
    assert SQUARE.contains((3.0005, -1))
    assert not SQUARE.contains((3.01, -1))
    assert SQUARE.contains((3.01, -1), tolerance_n=0.02)


def test_area_box_and_corners_of_a_square_are_known():
    assert SQUARE.area() == pytest.approx(8)
    box = SQUARE.bounding_box()
    np.testing.assert_allclose((box.low, box.high), [(-1, -3), (3, 1)], atol=1e-6)
    np.testing.assert_allclose(SQUARE.corners(), [(3, -1), (1, 1), (-1, -1), (1, -3)], atol=1e-6)


def test_the_area_of_many_corners_is_that_of_the_circle():
    assert Reachable(np.zeros(2), np.full(400, 3.0)).area() == pytest.approx(9 * np.pi, rel=1e-3)


@given(REGIONS)
@settings(deadline=None, max_examples=30)
def test_the_area_is_that_of_the_polygon(region):
    (ax, ay), (bx, by) = (points.T for points in sides(region))
    assert region.area() == pytest.approx((ax * by - ay * bx).sum() / 2, rel=1e-4)


def test_directions_go_anticlockwise_from_forward():
    np.testing.assert_allclose(directions(4), [(1, 0), (0, 1), (-1, 0), (0, -1)], atol=1e-6)


@given(REGIONS)
@settings(deadline=None, max_examples=30)
def test_it_comes_back_from_its_description(region):
    again = Reachable.from_dict(json.loads(json.dumps(region.to_dict())))
    np.testing.assert_allclose(again.corners(), region.corners(), atol=5e-5)


@pytest.mark.parametrize("scale", [1e-3, 0.06, 10.0, 1000.0])
def test_a_description_has_as_many_digits_for_a_fin_of_any_size(scale):
    region = Reachable(np.zeros(2, np.float32), scale * np.float32([1.234567, 2.345678, 1.111111]))
    again = Reachable.from_dict(region.to_dict())
    np.testing.assert_allclose(again.radius, region.radius, rtol=1e-5)


def test_the_description_of_the_papers_fin_has_five_decimals():
    region = Reachable(np.float32([1.234567, -1.234567]), np.full(4, 2.345678, np.float32))
    assert region.to_dict() == {"centre_n": [1.23457, -1.23457], "radius_n": [2.34568] * 4}


@pytest.mark.parametrize(
    "changes",
    [
        {"centre_n": [0.0]},
        {"centre_n": [0.0, float("nan")]},
        {"radius_n": [1.0, 1.0]},
        {"radius_n": [[1.0, 1.0, 1.0]]},
        {"radius_n": [1.0, 1.0, float("inf")]},
        {"radius_n": [1.0, 1.0, -1.0]},
        {"radius_n": "wide"},
        {"radius_n": None},
    ],
)
def test_a_damaged_description_is_refused(changes):
    with pytest.raises((TypeError, ValueError)):
        Reachable.from_dict(SQUARE.to_dict() | changes)


def test_a_description_without_a_part_is_refused():
    with pytest.raises(KeyError, match="radius_n"):
        Reachable.from_dict({"centre_n": [0.0, 0.0]})
