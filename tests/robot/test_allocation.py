"""Allocation against the issue of rank, closed forms and a general solver."""

import numpy as np
import pytest
from scipy.optimize import minimize

from softfin.robot.allocation import RIDGE, Allocator
from softfin.robot.description import load_robot

H = [0.866, -0.866, -0.866, 0.866]
TABLE = np.zeros((6, 8))
TABLE[0, ::2], TABLE[1, ::2], TABLE[2, 1::2] = H, [0.5, 0.5, -0.5, -0.5], 1
TABLE[3, 1::2], TABLE[4, 1::2], TABLE[5, ::2] = (
    [-0.150, -0.150, 0.150, 0.150],
    [-0.258, 0.258, 0.258, -0.258],
    [0.259, -0.259, 0.259, -0.259],
)
"""U-CAT's columns, fin after fin front right, back right, back left, front left: horizontal, up."""


PRIORITY = np.array([1.0, 1.0, 1.0, 30.0, 30.0, 30.0])


@pytest.fixture(scope="module")
def matrix():
    return load_robot("ucat").matrix()


def test_ucat_s_matrix_is_that_of_its_simulator(matrix):
    np.testing.assert_allclose(matrix, TABLE, atol=6e-4)
    np.testing.assert_allclose(
        np.linalg.svd(matrix)[1], [2, 1.732, 1, 0.518, 0.515, 0.300], atol=1e-3
    )


@pytest.mark.parametrize(("dead", "rank"), [((0,), 6), ((3,), 6), ((0, 1), 4), ((0, 2), 4)])
def test_ucat_keeps_all_axes_without_one_fin_and_four_without_two(matrix, dead, rank):
    left = np.delete(matrix, [2 * fin + axis for fin in dead for axis in (0, 1)], axis=1)
    assert np.linalg.matrix_rank(left, tol=1e-3) == rank


def test_what_the_fins_can_make_is_made_with_the_least_forces(matrix):
    wrench = np.array([1.0, -0.5, 0.8, 0.05, -0.1, 0.15])
    found = Allocator(matrix, np.full(4, 4.0), PRIORITY).allocate(wrench)
    np.testing.assert_allclose(found.wrench, wrench, atol=1e-3)
    np.testing.assert_allclose(found.forces.ravel(), np.linalg.pinv(matrix) @ wrench, atol=1e-3)
    assert not found.given_up.any()


def test_a_force_that_is_preferred_is_made_where_the_others_can_cancel_it(matrix):
    outward = np.tile([1.5, 0.0], (4, 1))
    found = Allocator(matrix, np.full(4, 4.0)).allocate(np.zeros(6), outward)
    np.testing.assert_allclose(found.forces, outward, atol=1e-3)
    np.testing.assert_allclose(found.wrench, 0, atol=1e-3)


@pytest.mark.parametrize("seed", range(30))
def test_where_fins_are_at_their_reach_it_is_the_optimum(matrix, seed):
    random = np.random.default_rng(seed)
    reach = random.uniform(0.5, 4, 4)
    priority = PRIORITY
    if seed % 5 == 0:
        reach[seed % 4] = 0
    wrench = random.normal(size=6) * [6, 5, 6, 1, 1.5, 1.5]
    preferred = random.normal(size=(4, 2))
    allocator = Allocator(matrix, reach, priority)
    found = allocator.allocate(wrench, preferred)
    for _ in range(20):
        found = allocator.allocate(wrench, preferred, found.forces)

    def cost(forces):
        missing = matrix @ forces - wrench
        alive = np.repeat(reach, 2) > 0
        apart = (forces - preferred.ravel())[alive] / np.repeat(reach, 2)[alive]
        return (priority * missing**2).sum() / 2 + RIDGE / 2 * (apart**2).sum()

    bounds = [
        {"type": "ineq", "fun": lambda f, i=i: reach[i] ** 2 - f[2 * i] ** 2 - f[2 * i + 1] ** 2}
        for i in range(4)
    ]
    best = minimize(
        cost,
        np.zeros(8),
        constraints=bounds,
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert (np.linalg.norm(found.forces, axis=1) <= reach + 1e-9).all()
    assert cost(found.forces.ravel()) <= best.fun * 1.03 + 1e-3


def test_an_axis_that_cannot_be_met_is_told(matrix):
    found = Allocator(matrix, np.full(4, 2.0), PRIORITY).allocate(
        np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.1])
    )
    assert found.given_up.tolist() == [True, False, False, False, False, False]
    assert found.wrench[0] == pytest.approx(4 * 2 * 0.866, rel=0.02)


@pytest.mark.parametrize("axis", range(6))
def test_a_small_force_or_moment_is_not_told_of(matrix, axis):
    small = 0.02 if axis < 3 else 0.005
    dead = Allocator(matrix, np.zeros(4))
    given_up = [dead.allocate(part * small * np.eye(6)[axis]).given_up for part in (0.95, 1.05)]
    assert np.argwhere(given_up).tolist() == [[1, axis]]
