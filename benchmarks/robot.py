"""A robot with four fins: allocation on one core, NumPy alone.

Wrenches are drawn up to 1.5 times what the fins make, so that about half of them are beyond reach.
The floor is what so many calls of NumPy on arrays of eight numbers cost: an allocation within reach
has seven, and each of Newton's steps thirty.
"""

import time
from typing import Any

import numpy as np

from benchmarks.controller_step import one_core
from benchmarks.measure import entry
from softfin.robot.allocation import Allocator
from softfin.robot.description import RobotConfig, load_robot

WRENCHES = 3000
REACH_N = 4.125
"""Of each fin."""


def main() -> list[dict[str, Any]]:
    robot = load_robot("ucat")
    with one_core():
        return allocation(robot, np.full(len(robot.fins), REACH_N))


def allocation(robot: RobotConfig, reach: np.ndarray) -> list[dict[str, Any]]:
    """Times of single allocations: all of them, and those within reach."""
    allocator = Allocator(robot.matrix(), reach, np.array(robot.allocation.priority))
    random = np.random.default_rng(0)
    limits = np.array([allocator.reach_along(axis) for axis in range(6)])
    wrenches = random.normal(size=(WRENCHES, 6))
    wrenches *= (1.5 * random.uniform(size=WRENCHES) / np.linalg.norm(wrenches, axis=1))[
        :, None
    ] * limits
    times = np.empty(WRENCHES)
    within = np.empty(WRENCHES, bool)
    for index, wrench in enumerate(wrenches):
        start = time.perf_counter()
        found = allocator.allocate(wrench)
        times[index] = time.perf_counter() - start
        within[index] = np.abs(found.wrench - wrench).max() < 1e-3
    small = np.ones(8)
    square = np.eye(8)
    start = time.perf_counter()
    for _ in range(1000):
        square @ small
    floor = 1000 * (time.perf_counter() - start)
    spread = {
        "p50_ms": 1000 * float(np.median(times)),
        "beyond_reach": float(1 - within.mean()),
        "call_us": floor,
    }
    return [
        entry(
            "allocation, p99",
            1000 * float(np.percentile(times, 99)),
            "ms",
            0.1,
            at_least=False,
            **spread,
        ),
        entry(
            "allocation within reach, p50",
            1000 * float(np.median(times[within])),
            "ms",
            0.02,
            at_least=False,
        ),
    ]
