"""Bracing of robots that lose fins: the three fins in a plane, five in a ring, U-CAT."""

import numpy as np
import pytest

from softfin.robot import bracing
from softfin.robot.bracing import BracedAllocation
from softfin.robot.description import RobotConfig

REACH_N = 4.0


def flat_robot(ucat, places):
    """Build a robot with fins in the horizontal plane, shafts upright."""
    fins = {
        f"fin_{number}": {
            "position_m": [x, y, 0],
            "zero_direction": [1, 0, 0],
            "shaft_axis": [0, 0, 1],
        }
        for number, (x, y) in enumerate(places)
    }
    values = ucat.model_dump(mode="json")
    return RobotConfig.build({**values, "name": "flat", "fins": fins}, "test")


@pytest.fixture(params=["three in a plane", "five in a ring", "U-CAT"])
def robot(request, ucat):
    angles = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    robots = {
        "three in a plane": flat_robot(ucat, [(0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2)]),
        "five in a ring": flat_robot(
            ucat, 0.3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        ),
        "U-CAT": ucat,
    }
    return robots[request.param]


def drawn_wrenches(robot, count):
    """Draw wrenches that the fins can make."""
    random = np.random.default_rng(0)
    forces = random.uniform(-REACH_N / 2, REACH_N / 2, (count, robot.matrix().shape[1]))
    return forces @ robot.matrix().T


def share_in_turn(allocation, wrenches, forces, brace):
    for wrench in wrenches:
        action, brace = allocation.share(wrench, forces, brace)
        forces = action.forces
    return action, brace


def test_fins_may_die_at_any_moment_one_after_the_other(robot):
    count = len(robot.fins)
    wrenches = drawn_wrenches(robot, 40)
    for first in range(count):
        for moment in range(1, 30):
            allocation = BracedAllocation(robot, [REACH_N] * count)
            rest = np.zeros((count, 2))
            action, brace = share_in_turn(allocation, wrenches[:moment], rest, rest)
            dead = []
            for fin in (first, (first + 1) % count):
                dead.append(fin)
                allocation.declare_dead(fin)
                action, brace = share_in_turn(
                    allocation, wrenches[moment : moment + 3], action.forces, brace
                )
                assert not action.forces[dead].any()
                assert not brace[dead].any()


def test_after_a_death_no_bracing_is_kept_that_the_fins_did_not_have(robot, monkeypatch):
    count = len(robot.fins)
    rest = np.zeros((count, 2))
    for wrench in drawn_wrenches(robot, 20):
        monkeypatch.setattr(bracing, "BRACE_CHANGE_N2", 0)
        allocation = BracedAllocation(robot, [REACH_N] * count)
        action, brace = allocation.share(wrench, rest, rest)
        if not brace[0].any():
            continue
        allocation.declare_dead(0)
        _, best = allocation.share(wrench, action.forces, brace)
        # Nothing changes a bracing that it costs so much to change.
        monkeypatch.setattr(bracing, "BRACE_CHANGE_N2", 1e6)
        _, kept = allocation.share(wrench, action.forces, brace)
        np.testing.assert_allclose(kept, best)


def test_a_bracing_that_costs_much_to_change_is_kept(robot, monkeypatch):
    count = len(robot.fins)
    allocation = BracedAllocation(robot, [REACH_N] * count)
    rest = np.zeros((count, 2))
    monkeypatch.setattr(bracing, "BRACE_CHANGE_N2", 0)
    _, brace = allocation.share(drawn_wrenches(robot, 1)[0], rest, rest)
    monkeypatch.setattr(bracing, "BRACE_CHANGE_N2", 1e6)
    for wrench in drawn_wrenches(robot, 20):
        _, kept = allocation.share(wrench, rest, brace)
        np.testing.assert_allclose(kept, brace)
