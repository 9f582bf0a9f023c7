"""The nearest force of a star-shaped reach and some cells, against a fine lattice of candidates."""

import numpy as np

from softfin.gaits.reachable import EDGE_FRACTION, Cell, Reachable

RADIUS = 1 + 0.4 * np.cos(3 * np.linspace(0, 2 * np.pi, 64, endpoint=False))
CLOVER = Reachable(np.float32([0.5, 0]), RADIUS.astype(np.float32))
CELLS = (Cell(low=(0, -0.5), high=(1, 0.25)), Cell(low=(1, 0.5), high=(2, 1.5)))
FORCES = np.random.default_rng(0).uniform(-3, 3, (40, 2))


def test_it_is_as_near_as_any_force_that_both_hold():
    near = CLOVER.nearest_within(CELLS, FORCES)
    lattice = np.stack(np.meshgrid(*[np.linspace(-2, 3, 501)] * 2), axis=-1).reshape(-1, 2)
    lattice = lattice[CLOVER.contains(lattice)]
    lattice = lattice[
        [min(cell.distance((x, y)) for cell in CELLS) == 0 for x, y in lattice.tolist()]
    ]
    best = np.hypot(*np.moveaxis(lattice - FORCES[:, None], -1, 0)).min(axis=1)
    ours = np.hypot(*(near - FORCES).T)
    assert (ours <= best + 4 * EDGE_FRACTION * CLOVER.radius.max()).all()
    assert (best <= ours + 0.02).all()
    assert all(min(cell.distance((x, y)) for cell in CELLS) == 0 for x, y in near.tolist())
    assert CLOVER.contains(near).all()


def test_what_is_in_both_stays_to_the_last_bit():
    inside = np.array([[0.5, 0.1], [0.9, -0.4]])
    np.testing.assert_array_equal(CLOVER.nearest_within(CELLS, inside), inside)


def test_where_reach_and_cells_do_not_meet_there_is_none():
    assert np.isnan(CLOVER.nearest_within((Cell(low=(5, 5), high=(6, 6)),), FORCES[:2])).all()


def test_corners_without_radius_are_no_obstacle() -> None:
    """Sides between them have no length, and lie outside the cell."""
    radius = np.zeros(8, np.float32)
    radius[[0, 7]] = 2
    region = Reachable(np.zeros(2, np.float32), radius)
    cell = Cell(low=(0.5, -0.6), high=(1.5, -0.2))
    nearest = region.nearest_within([cell], np.array([[3.0, -3.0]]))
    np.testing.assert_allclose(nearest, [[1.5, -0.6]], atol=1e-6)
