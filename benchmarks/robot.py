"""A robot with four fins: allocation on one core, NumPy alone; and whole trials, one robot and 64
side by side.

Wrenches are drawn up to 1.5 times what the fins make, so that about half of them are beyond reach.
The floor is what so many calls of NumPy on arrays of eight numbers cost: an allocation within reach
has seven, and each of Newton's steps thirty. A trial is body, four fins in the tank, controller of
motion and wrench driver, 100 readings a second.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.controller_step import one_core
from benchmarks.measure import entry
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import TICK_S, Command
from softfin.robot.allocation import Allocator
from softfin.robot.description import load_robot
from softfin.robot.evaluate import find_all_gaits
from softfin.robot.motion_control import MotionController
from softfin.robot.paths import hold_place
from softfin.robot.simulation import Ambient, Orders, RobotSimulation
from softfin.robot.trial import run_trial
from softfin.robot.wrench_driver import WrenchDriver
from softfin.tank import Tank

WRENCHES = 3000
SECONDS = 60.0
BATCH = 64
ACTIONS = 12


def main() -> list[dict[str, Any]]:
    robot = load_robot("ucat")
    tanks = [Tank()] * 4
    gaits = find_all_gaits(tanks)
    with one_core():
        rows = allocation(robot, np.array([each.reach for each in gaits]))
    simulation = RobotSimulation(robot, tanks)
    run_trial(simulation, WrenchDriver(robot, gaits), hold_place(), 2)
    start = time.perf_counter()
    run_trial(simulation, WrenchDriver(robot, gaits), hold_place(), SECONDS)
    spent = time.perf_counter() - start
    rows.append(entry("one robot, simulated over real time", SECONDS / spent, "-", 50))
    return [*rows, batch(robot, simulation, gaits)]


def allocation(robot: Any, reach: np.ndarray) -> list[dict[str, Any]]:
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


def batch(robot: Any, simulation: RobotSimulation, gaits: Any) -> dict[str, Any]:
    """64 robots that hold their places, all in one program, each with a controller and a driver of
    its own."""
    drivers = [WrenchDriver(robot, gaits) for _ in range(BATCH)]
    controller = MotionController(robot)
    still = hold_place()(0.0)
    advance = jax.jit(jax.vmap(simulation.advance, in_axes=(0, 0, None, None)))
    states = jax.vmap(simulation.init)(jax.random.split(jax.random.key(0), BATCH))
    around = Ambient(jnp.asarray([0.03, 0.0, 0.0]), jnp.zeros(6))
    control = [controller.init()] * BATCH
    driving = [driver.init() for driver in drivers]
    before = Command(jnp.zeros((BATCH, len(gaits))), jnp.ones((BATCH, len(gaits))))
    seen = [[np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 6))]] * BATCH
    start = time.perf_counter()
    for action in range(ACTIONS + 1):
        if action == 1:
            start = time.perf_counter()
        orders = []
        now = []
        for index, driver in enumerate(drivers):
            control[index], wrench = controller.act(
                control[index], seen[index], still, still, still
            )
            driving[index], driven = driver.act(driving[index], wrench)
            control[index] = controller.acknowledge(control[index], driven.wrench, still)
            now.append(driven.commands)
            orders.append(driven.delays)
        angles, velocities = np.array(now, np.float32).transpose(2, 0, 1)
        commands = Command(jnp.asarray(angles), jnp.asarray(velocities))
        states, rows = advance(
            states, Orders(before, commands, jnp.asarray(orders)), around, PAPER_CLOCK.ticks[0]
        )
        before = commands
        body = jax.tree.map(np.asarray, rows.body)
        seen = [
            [body.position[index], body.attitude[index], body.twist[index]]
            for index in range(BATCH)
        ]
    spent = time.perf_counter() - start
    simulated = BATCH * ACTIONS * PAPER_CLOCK.ticks[0] * TICK_S
    return entry(f"{BATCH} robots, simulated over real time", simulated / spent, "-", 200)
