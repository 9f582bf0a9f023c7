"""Motion control without a simulation: the current that a robot with a dead fin turns into."""

import numpy as np
import pytest

from softfin.robot.motion_control import MotionController
from softfin.robot.paths import hold_place
from softfin.robot.rotation import from_euler

SWAY_REACH_N = 4.0


def hold_still(controller, wrench, actions, state=None, surge_noise_n=0.0):
    """Let the fins make a wrench that keeps the robot where it is, rolled as far as the wrench
    rolls it."""
    target = hold_place()(0.0)
    roll_rad = wrench[3] / controller.dynamics.righting_nm_rad
    still = np.zeros((66, 3)), np.zeros((66, 6))
    random = np.random.default_rng(0)
    state = state or controller.init()
    for _ in range(actions):
        # The robot has turned to its heading.
        attitude = np.tile(from_euler(roll_rad, 0.0, state.heading), (66, 1))
        state, _ = controller.act(state, (still[0], attitude, still[1]), target, target, target)
        noise = np.array([surge_noise_n * random.normal(), 0, 0, 0, 0, 0])
        state = controller.acknowledge(state, np.asarray(wrench) + noise, target)
    return state


def controller_without_a_fin(robot):
    controller = MotionController(robot)
    controller.sway_reach_n = SWAY_REACH_N
    return controller


@pytest.mark.parametrize("name", ["ucat", "sister"])
def test_an_error_dies_away_at_the_bandwidth_without_overshoot(request, name):
    """As a critically damped oscillator does, e(t) = e(0) (1 + w t) exp(-w t), where forces act at
    once."""
    robot = request.getfixturevalue(name)
    control = robot.control.model_copy(update={"lag_s": 0.0, "damping": 1.0})
    controller = MotionController(robot.model_copy(update={"control": control}))
    bandwidth_rad_s = np.array(control.bandwidth_rad_s)
    step_s = 0.001
    disturbance = np.array([0.1, -0.2, 0.3, 0.1, -0.1, 0.2])
    start = np.array([0.2, -0.1, 0.1, 0.1, -0.1, 0.3])
    error = start
    rate = np.zeros(6)
    for number in range(1, 3001):
        estimate = np.stack([error, rate, disturbance], axis=1)
        acceleration = controller.corrected(estimate, np.zeros((2, 6))) + disturbance
        rate = rate + step_s * acceleration
        error = error + step_s * rate
        turned = bandwidth_rad_s * step_s * number
        np.testing.assert_allclose(error, start * (1 + turned) * np.exp(-turned), atol=1e-3)


@pytest.mark.parametrize("roll_nm", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("name", ["ucat", "sister"])
def test_a_roll_that_the_weight_holds_is_no_current(request, name, roll_nm):
    robot = request.getfixturevalue(name)
    for part, turns in ((0.5, False), (0.7, True)):
        wrench = [0.5, part * SWAY_REACH_N, 0, roll_nm, 0, 0]
        controller = MotionController(robot)
        settled = hold_still(controller, wrench, 300)
        controller.sway_reach_n = SWAY_REACH_N
        after = hold_still(controller, wrench, 60, settled)
        assert (after.heading > 0.2) == turns
        assert (after.heading == 0) == (not turns)


@pytest.mark.parametrize("name", ["ucat", "sister"])
@pytest.mark.parametrize("surge_n", [-2.0, 2.0])
@pytest.mark.parametrize("sway_n", [-SWAY_REACH_N, SWAY_REACH_N])
def test_a_robot_turns_the_shorter_way_into_a_current(request, name, surge_n, sway_n):
    controller = controller_without_a_fin(request.getfixturevalue(name))
    state = hold_still(controller, [surge_n, sway_n, 0, 0, 0, 0], 60)
    assert np.sign(state.heading) == np.sign(surge_n * sway_n)


@pytest.mark.parametrize("name", ["ucat", "sister"])
def test_a_turn_to_the_wrong_side_is_taken_back_for_more_than_noise(request, name):
    controller = controller_without_a_fin(request.getfixturevalue(name))
    begun = hold_still(controller, [0.1, SWAY_REACH_N, 0, 0, 0, 0], 30)
    assert begun.side == 1
    weak = hold_still(controller, [-0.1, SWAY_REACH_N, 0, 0, 0, 0], 120, begun, surge_noise_n=0.3)
    assert weak.side == 1
    assert weak.heading > begun.heading
    strong = hold_still(controller, [-2.0, SWAY_REACH_N, 0, 0, 0, 0], 120, begun, surge_noise_n=0.3)
    assert strong.side == -1
    assert strong.heading < begun.heading
