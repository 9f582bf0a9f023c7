"""Wrenches asked for and made; phases; dead fins."""

import numpy as np
import pytest

from softfin.core.errors import RunError
from softfin.robot.baselines import build_drivers
from softfin.robot.evaluate import RobotEvaluateConfig, draw_wrenches, wrench_errors
from softfin.robot.phases import choose_phases, phase_delay, stroke_side
from softfin.robot.wrench_driver import WrenchDriver


def acted(driver, wrench, actions):
    state = driver.init()
    for _ in range(actions):
        state, orders = driver.act(state, np.asarray(wrench, float))
    return state, orders


@pytest.mark.slow
def test_fins_in_the_tank_make_the_wrenches_and_their_ripple_cancels(ucat, simulation, gaits):
    wrenches = draw_wrenches(ucat, gaits, RobotEvaluateConfig(wrenches=16))
    drivers = build_drivers(ucat, gaits)
    found, free = (
        wrench_errors(simulation, drivers[name], wrenches) for name in ("whole", "without phases")
    )
    assert found["force_error_n"] <= 0.15
    assert found["moment_error_nm"] <= 0.04
    assert found["ripple"]["roll"] <= 0.7 * free["ripple"]["roll"]


def test_a_robot_that_is_asked_for_nothing_braces_its_fins(ucat, gaits):
    _, orders = acted(WrenchDriver(ucat, gaits), np.zeros(6), 12)
    assert (np.linalg.norm(orders.forces, axis=1) > 1).all()
    np.testing.assert_allclose(orders.wrench, 0, atol=0.01)


def test_bracing_does_not_depend_on_how_the_library_of_linear_algebra_turns_what_makes_no_wrench(
    ucat, gaits, monkeypatch
):
    svd = np.linalg.svd
    (_, as_it_is) = acted(WrenchDriver(ucat, gaits), np.zeros(6), 12)

    def turned(matrix):
        left, values, rows = svd(matrix)
        cos = np.cos(0.7)
        sin = np.sin(0.7)
        return left, values, np.vstack([rows[:-2], [[cos, sin], [sin, -cos]] @ rows[-2:]])

    monkeypatch.setattr(np.linalg, "svd", turned)
    _, orders = acted(WrenchDriver(ucat, gaits), np.zeros(6), 12)
    np.testing.assert_allclose(orders.forces, as_it_is.forces, atol=1e-9)


def test_a_robot_without_a_fin_left_asks_for_nothing(ucat, gaits):
    driver = WrenchDriver(ucat, gaits)
    for fin in range(4):
        driver.declare_dead(fin)
    _, orders = acted(driver, [1, 0.5, 0, 0, 0, 0.1], 3)
    assert not orders.forces.any()
    assert orders.given_up.any()


def test_all_of_a_wrench_within_reach_is_made_without_one_fin(ucat, gaits):
    driver = WrenchDriver(ucat, gaits)
    driver.declare_dead(1)
    _, orders = acted(driver, [1, 0.5, 0, 0, 0, 0.1], 16)
    np.testing.assert_allclose(orders.wrench, [1, 0.5, 0, 0, 0, 0.1], atol=0.02)
    assert orders.forces[1].tolist() == [0, 0]
    assert not orders.given_up.any()


def test_what_is_given_up_is_told_in_words(ucat, gaits):
    wrench = np.array([0, 20, 0, 0, 0, 0], float)
    _, orders = acted(WrenchDriver(ucat, gaits), wrench, 12)
    assert orders.told(wrench).startswith("out of the fins' reach: sway 8.")
    assert orders.told(wrench).endswith("of 20.00 N")
    assert acted(WrenchDriver(ucat, gaits), np.zeros(6), 2)[1].told(np.zeros(6)) == ""


def test_a_wrench_that_is_not_finite_changes_nothing(ucat, gaits):
    driver = WrenchDriver(ucat, gaits)
    with pytest.raises(RunError, match="six finite numbers"):
        driver.act(driver.init(), np.array([0, np.nan, 0, 0, 0, 0]))


def test_equal_ripples_that_oppose_each_other_are_put_in_phase():
    ripple = np.zeros((6, 2), complex)
    ripple[3] = 1, -1
    assert len(set(choose_phases(np.array([0, 3]), True, ripple, np.eye(6)).tolist())) == 1
    ripple[3] = 1, 1
    phases = choose_phases(np.array([2, 2]), True, ripple, np.eye(6))
    assert (phases[1] - phases[0]) % 6 == 3


def test_while_fins_stroke_a_little_ripple_more_is_kept():
    ripple = np.zeros((6, 2), complex)
    ripple[3] = 1, 0.2
    present = np.array([0, 0])
    assert choose_phases(present, False, ripple, np.eye(6)) is present


def test_phases_are_sixths_of_a_period():
    assert [(phase_delay(phase), stroke_side(phase, 0)) for phase in range(6)] == [
        (0, 1),
        (11, 1),
        (22, 1),
        (0, -1),
        (11, -1),
        (22, -1),
    ]
    assert stroke_side(0, 1) == -1


def test_a_fin_that_dies_makes_nothing_from_then_on(ucat, gaits):
    driver = WrenchDriver(ucat, gaits)
    wrench = np.array([6.0, 0, 0, 0, 0, 0])
    state = driver.init()
    for _ in range(4):
        state, _ = driver.act(state, wrench)
    driver.declare_dead(3)
    _, orders = driver.act(state, wrench)
    assert not orders.forces[3].any()
    assert orders.wrench[0] < 5.5
    for fin in range(3):
        driver.declare_dead(fin)
    _, orders = driver.act(state, wrench)
    assert not orders.wrench.any()
