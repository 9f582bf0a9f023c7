"""The robot's node in simulation: what its fins do in their tanks, and the errors of their
wrench."""

import jax
import numpy as np
import pytest

from softfin.control.controller import LoadedController
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import RATE_HZ
from softfin.evaluation import experiment
from softfin.gaits.reachable import Cell
from softfin.robot import bracing, evaluate
from softfin.robot.evaluate import (
    PART_OF_REACH,
    RobotEvaluateConfig,
    SimulatedFin,
    draw_targets,
    evaluate_robot,
    fin_loads,
    newest_references,
)
from softfin.stages.example import EXAMPLE
from softfin.tank import Tank, TankConfig
from tests.staged import COARSE


@pytest.fixture(scope="module")
def fin():
    """A fin with gaits for forces around 2 N forward."""
    return SimulatedFin(load_controller(EXAMPLE / "gaits"), Tank(TankConfig.build(COARSE, "tank")))


def test_a_fin_does_what_it_does_in_an_experiment(fin):
    forces = np.array([[1.0, 0.5], [2.0, -0.5]])
    seconds = 3
    ticks = seconds * RATE_HZ
    sent = np.repeat(forces[:, None], 12, axis=1)
    found, torque, power = fin_loads(fin, sent, np.array([0, 40]), ticks, jax.random.key(0))
    recording = experiment.run(fin.controller, fin.tank, forces, seconds, jax.random.key(0)[None])
    np.testing.assert_allclose(found[:, 0], recording.force[:, 0], atol=2e-3)
    assert not found[:, 1, :40].any(), "at rest until it starts"
    np.testing.assert_allclose(found[:, 1, 40:], found[:, 0, : ticks - 40], atol=1e-6)
    assert np.abs(torque).max() > 0.05
    np.testing.assert_allclose(torque[:, 1, 40:], torque[:, 0, : ticks - 40], atol=1e-6)
    np.testing.assert_allclose(power[:, 0], recording.power[:, 0], rtol=0.01, atol=0.02)
    assert not power[:, 1, :40].any()


@pytest.mark.parametrize("clock", [PAPER_CLOCK, ActionClock.at(6), ActionClock.at(2, 3)])
def test_a_fin_follows_the_newest_reference_at_its_own_clock(clock):
    starts = [0, 1, 33, 57]
    newest = newest_references(clock, np.array(starts), clock.actions_within(400), 20)
    sent_at = [sum(PAPER_CLOCK.action_ticks(action)) for action in range(20)]
    for start, row in zip(starts, newest, strict=True):
        for action, index in enumerate(row):
            now = start + sum(clock.action_ticks(action))
            assert index == max(i for i, tick in enumerate(sent_at) if tick <= now)


@pytest.fixture
def exact_fins(monkeypatch):
    """Fins that make their reference at once, and a torque of 0.1 N m about their shafts."""

    def loads(fin, references, starts, ticks, key):
        force = np.broadcast_to(references[:, None, -1:], (len(references), len(starts), ticks, 2))
        return force, np.full(force.shape[:3], 0.1), np.full(force.shape, (2.0, 4.0))

    monkeypatch.setattr(evaluate, "fin_loads", loads)


def with_reach(fin, reachable):
    """The fin, with a controller for all references, of which it can make those."""
    everything = Cell(low=(-9, -9), high=(9, 9))
    controller = LoadedController(
        fin.controller.step, fin.controller.limits, (everything,), reachable
    )
    return fin._replace(controller=controller)


@pytest.mark.parametrize("dead", [None, "back_left"])
def test_fins_that_make_their_references_miss_the_target_by_their_torque(
    ucat, fin, exact_fins, dead, monkeypatch
):
    monkeypatch.setattr(bracing, "SMOOTHING", 0)
    robot = ucat.merged({"allocation": {"brace_n": 0}}, "test")
    config = RobotEvaluateConfig(max_thrust=3.0, targets=4, repeats=2, dead=dead)
    found = evaluate_robot(robot, [with_reach(fin, None)] * 4, config)
    shafts = [np.array(mount.shaft_axis) for name, mount in robot.fins.items() if name != dead]
    torque = np.abs(0.1 * np.sum(shafts, axis=0))
    errors = list(found["error"].values())
    np.testing.assert_allclose(errors, [0, 0, 0, *torque], atol=3e-3)
    np.testing.assert_allclose(list(found["error_of_references"].values()), 0, atol=2e-3)
    assert not any(found["ripple"].values())
    assert found["targets_given_up"] == found["references_unreachable"] == 0
    assert found["dead"] == dead


def test_targets_are_within_the_reach_of_the_fins_that_are_left(ucat):
    config = RobotEvaluateConfig(targets=500)
    wrenches = draw_targets(ucat, [3.0] * 4, [1], config)
    matrix = ucat.matrix()[:, [0, 1, 4, 5, 6, 7]]
    forces = wrenches @ np.linalg.pinv(matrix).T
    np.testing.assert_allclose(forces @ matrix.T, wrenches, atol=1e-9)
    sizes = np.linalg.norm(forces.reshape(-1, 2), axis=1)
    assert 0.95 * PART_OF_REACH * 3 < sizes.max() <= PART_OF_REACH * 3


def test_references_that_a_fin_cannot_make_are_counted(ucat, fin, exact_fins):
    """Its gaits push forward only."""
    config = RobotEvaluateConfig(max_thrust=2.0, targets=4, repeats=1)
    forward = with_reach(fin, fin.controller.reachable)
    found = evaluate_robot(ucat, [forward] * 4, config)
    assert 0.1 < found["references_unreachable"] < 0.9
    # These fins make exactly what they track.
    assert found["error_of_references"]["heave"] > 0.1
    assert found["error"]["heave"] == pytest.approx(found["error_of_references"]["heave"])


def test_a_dead_fin_that_the_robot_does_not_have_is_told_with_those_that_it_has(ucat, fin):
    with pytest.raises(ConfigurationError, match=r"dead = tail: .* front_right, back_right"):
        evaluate_robot(ucat, [fin] * 4, RobotEvaluateConfig(max_thrust=3.0, dead="tail"))


def test_a_robot_keeps_a_fin(ucat, fin):
    name = "front_left"
    alone = ucat.model_copy(update={"fins": {name: ucat.fins[name]}})
    with pytest.raises(ConfigurationError, match="has no other fin"):
        evaluate_robot(alone, [fin], RobotEvaluateConfig(max_thrust=3.0, dead=name))
