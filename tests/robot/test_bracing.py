"""Bracing of robots that lose fins: the three fins in a plane, five in a ring, U-CAT."""

import numpy as np
import pytest

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


def test_after_a_death_no_bracing_is_kept_that_the_fins_did_not_have(robot):
    count = len(robot.fins)
    # Nothing changes a bracing that it costs so much to change.
    stubborn = robot.merged({"allocation": {"brace_change": 1e6}}, "test")
    free = robot.merged({"allocation": {"brace_change": 0}}, "test")
    rest = np.zeros((count, 2))
    for wrench in drawn_wrenches(robot, 20):
        before = BracedAllocation(free, [REACH_N] * count)
        action, brace = before.share(wrench, rest, rest)
        if not brace[0].any():
            continue
        allocations = [BracedAllocation(each, [REACH_N] * count) for each in (stubborn, free)]
        for allocation in allocations:
            allocation.declare_dead(0)
        (_, kept), (_, best) = (each.share(wrench, action.forces, brace) for each in allocations)
        np.testing.assert_allclose(kept, best)


def test_a_bracing_that_costs_much_to_change_is_kept(robot):
    count = len(robot.fins)
    stubborn, free = (
        BracedAllocation(
            robot.merged({"allocation": {"brace_change": cost}}, "test"), [REACH_N] * count
        )
        for cost in (1e6, 0)
    )
    rest = np.zeros((count, 2))
    _, brace = free.share(drawn_wrenches(robot, 1)[0], rest, rest)
    for wrench in drawn_wrenches(robot, 20):
        _, kept = stubborn.share(wrench, rest, brace)
        np.testing.assert_allclose(kept, brace)
