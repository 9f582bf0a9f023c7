"""Close a loop around the wrench of a robot's node: U-CAT holds its position in a current.

    softfin example example
    python examples/robot/hold_position.py example/gaits --out hold.png

A PID controller of position and heading computes a target wrench three times per second.
`FinReferences` distributes it among the fins, as `softfin robot ros2` does, and each fin's
controller tracks its reference in a tank that moves with the body. The controller knows the exact
position and velocity of the body; a real robot has to estimate both.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from body import REST, UCAT, Body, BodyState
from fins import TankFins

from softfin.control.store import load_controller
from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.robot.description import RobotConfig, load_robot
from softfin.robot.references import NODE_CLOCK, FinReferences
from softfin.storage.figures import BLUE, ORANGE, new_figure, save_figure, styled
from softfin.storage.registry import find_plant

DRAG_LINEAR = np.array([28.5, 100.7, 30.6, 0, 0, 0.313])
DRAG_QUADRATIC = np.array([22.0, 260, 161, 3.42, 2.10, 0.723])
"""Drag of U-CAT, from its laboratory's simulator."""

BANDWIDTH_RAD_S = np.array([0.7, 0.7, 0.4, 0, 0, 0.6])
"""Bandwidth of the control of each axis [rad/s]; the delay of the fins allows no more. Roll and
pitch are left to the body's weight and buoyancy."""

INTEGRAL = 0.3
"""Rate of the integral term, as a fraction of the bandwidth."""

PUSH_S = 0.5
"""Duration of the push [s]."""


class Push(NamedTuple):
    """Current and push that disturb the robot, in world axes."""

    current_m_s: np.ndarray
    impulse_n_s: np.ndarray
    at_s: float

    def force(self, time: float) -> np.ndarray:
        """Return the force of the push at a time [N]."""
        acts = self.at_s <= time < self.at_s + PUSH_S
        return self.impulse_n_s / PUSH_S if acts else np.zeros(3)


class PositionController:
    """PID control of position and heading; the target is the origin, heading along x."""

    def __init__(self, inertia: np.ndarray) -> None:
        self._inertia = inertia
        self._integral = np.zeros(6)

    def act(self, states: list[BodyState], current: np.ndarray, given_up: np.ndarray) -> np.ndarray:
        """Return the target wrench for the next action, from the states during the last one.

        Averages over the action remove most of the motion due to single strokes.
        """
        errors = []
        velocities = []
        for position, rotation, twist in states:
            heading = np.arctan2(rotation[1, 0], rotation[0, 0])
            errors.append([*(-position @ rotation), 0, 0, -heading])
            drift = np.concatenate([current @ rotation, np.zeros(3)])
            velocities.append(twist + drift)
        error = np.mean(errors, axis=0)
        velocity = np.mean(velocities, axis=0)
        # The integral waits while the fins cannot produce the wrench.
        self._integral += np.where(given_up, 0, error / NODE_CLOCK.rate_hz)
        rate = BANDWIDTH_RAD_S
        # Characteristic polynomial (s + rate)^2 for mass alone, plus a slow integral.
        acceleration = rate**2 * (error + INTEGRAL * rate * self._integral) - 2 * rate * velocity
        return self._inertia @ acceleration


class Run(NamedTuple):
    """Record of a run, one row per tick of 10 ms."""

    distance_m: np.ndarray
    """Distance from the target."""
    heading_rad: np.ndarray
    tilt_rad: np.ndarray
    """Angle between the body's z axis and upwards."""


FinsTick = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""`TankFins.tick`, or other fins."""


def hold_position(
    robot: RobotConfig,
    body: Body,
    fins_tick: FinsTick,
    max_thrust_n: float,
    seconds: float,
    push: Push,
) -> Run:
    """Simulate a robot that starts at its target, at rest over ground."""
    node = FinReferences(robot, [max_thrust_n] * len(robot.fins))
    controller = PositionController(body.inertia)
    twist = np.concatenate([-push.current_m_s, np.zeros(3)])
    state = REST._replace(twist=twist)
    acceleration = np.zeros(6)
    states = [state]
    given_up = np.zeros(6, bool)
    rows = []
    for ticks in NODE_CLOCK.action_ticks(round(seconds * NODE_CLOCK.rate_hz)):
        allocation = node.act(controller.act(states, push.current_m_s, given_up))
        given_up = allocation.given_up
        states = []
        for _ in range(ticks):
            wrench = fins_tick(allocation.forces, state.twist, acceleration)
            wrench[:3] += push.force(len(rows) * TICK_S) @ state.rotation
            acceleration = body.acceleration(state, wrench)
            state = body.step(state, acceleration, push.current_m_s)
            states.append(state)
            heading = np.arctan2(state.rotation[1, 0], state.rotation[0, 0])
            tilt = np.arccos(np.clip(state.rotation[2, 2], -1, 1))
            rows.append((np.linalg.norm(state.position), heading, tilt))
    return Run(*np.array(rows).T)


def draw(run: Run, path: Path) -> None:
    """Draw the distance from the target and the angles over time."""
    time = np.arange(1, len(run.distance_m) + 1) / RATE_HZ
    with styled():
        figure = new_figure(8.0, 3.4)
        distance, angles = figure.subplots(2, 1, sharex=True)
        distance.plot(time, 100 * run.distance_m, color=BLUE)
        distance.set(ylabel="distance from\nthe target [cm]", ylim=(0, None))
        angles.plot(time, np.degrees(run.heading_rad), color=BLUE, label="heading")
        angles.plot(time, np.degrees(run.tilt_rad), color=ORANGE, lw=0.8, label="tilt")
        angles.set(ylabel="angle [degrees]", xlabel="time [s]")
        angles.legend(loc="lower right")
        save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("controller", type=Path)
    parser.add_argument("--plant", default="tank")
    parser.add_argument("--max-thrust", type=float, default=3.0)
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("hold.png"))
    options = parser.parse_args()
    robot = load_robot("ucat")
    controller = load_controller(options.controller)
    random = np.random.default_rng(options.seed)
    starts = random.integers(controller.clock.window_ticks, size=len(robot.fins))
    fins = TankFins(robot, controller, find_plant(options.plant), starts.tolist())
    # Directions of the current and of the push.
    along, pushed = random.uniform(-np.pi, np.pi, 2)
    push = Push(
        0.03 * np.array([np.cos(along), np.sin(along), 0]),
        1.0 * np.array([np.cos(pushed), np.sin(pushed), 0]),
        options.seconds / 2,
    )
    body = Body(UCAT, DRAG_LINEAR, DRAG_QUADRATIC)
    run = hold_position(robot, body, fins.tick, options.max_thrust, options.seconds, push)
    draw(run, options.out)
    last = run.distance_m[-10 * RATE_HZ :]
    print(f"RMS distance over the last 10 s: {100 * np.sqrt(np.mean(last**2)):.1f} cm")


if __name__ == "__main__":
    main()
