"""Motion control in 6 degrees of freedom: computed torque along a path, with an observer for each
axis. NumPy only.

The wrench that the path needs is computed from the body's model; errors are corrected by
proportional and derivative action; and a Kalman filter for each axis estimates the error, its rate
and a constant disturbance, which is compensated. The filter gets the wrench that the allocator
made, not the requested one, so nothing winds up (Fossen 2021, ch. 13 and 15; Sariyildiz, Oboe and
Ohnishi 2020). Body axes are used in place of path axes, so the body must be rotated from the path
by less than about a radian.

Fins stroke at half the actions' rate. An error is therefore a mean over two actions, in which
strokes cancel: sampled once per action, a stroke would look like a constant error.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.errors import RunError
from softfin.robot.control_config import ControlConfig
from softfin.robot.description import RobotConfig
from softfin.robot.dynamics import Dynamics
from softfin.robot.paths import PathPoint, path_error, path_twist
from softfin.robot.rotation import (
    SixVector,
    cross,
    from_euler,
    matrix,
    multiply,
    normalized,
    six,
)

ACTION_S = 1 / ACTION_RATE_HZ

SEEN_ACTIONS = 2
"""Number of actions over which an error is averaged: one whole period of the strokes."""


AxisEstimates = Float[np.ndarray, "6 3"]
AxisTransitions = Float[np.ndarray, "6 3 3"]


class AxisFilter(NamedTuple):
    """Filters of the six axes: x = (error, its rate, disturbance's acceleration), u = acceleration
    by the fins."""

    forward: AxisTransitions
    """Transition from one action to the next."""
    driven: AxisEstimates
    gain: Float[np.ndarray, "6 3 2"]
    """Steady-state gain of the Kalman filter."""
    back: Float[np.ndarray, "6 2 3"]
    """Mean error and rate over the last two actions, from the state now."""
    driven_back: Float[np.ndarray, "6 2"]
    ahead: AxisTransitions
    """Transition to the time at which new forces act."""
    driven_ahead: AxisEstimates
    deviation: Float[np.ndarray, "6"]
    """Standard deviation of the estimated disturbance [m/s2, rad/s2]."""

    @classmethod
    def of(
        cls,
        config: ControlConfig,
        stiffness: SixVector,
        damping: SixVector,
        noise: Float[np.ndarray, "6 2"],
    ) -> "AxisFilter":
        """Build the filters; stiffness [1/s2] and damping [1/s] are those of the body itself, and
        the noise is that of error and rate."""
        rows = []
        for axis in range(6):
            # d/dt (error, rate, disturbance, u): the body's own spring and damper, driven by the
            # disturbance and by the fins. The disturbance and u are constant within an action.
            slope = np.array(
                [[0, 1, 0, 0], [-stiffness[axis], -damping[axis], 1, 1], [0, 0, 0, 0], [0, 0, 0, 0]]
            )
            step = _exponential(slope * ACTION_S)
            half = np.linalg.inv(step)
            forward = step[:3, :3]
            driven = step[:3, 3]
            back = half[:2, :3]
            driven_back = half[:2, 3]
            walk = config.disturbance[axis] ** 2 * ACTION_S
            spread = np.outer(driven, driven) * config.force_noise[axis] ** 2
            spread[2, 2] += walk
            measured = np.diag(noise[axis] ** 2)
            covariance = np.eye(3)
            # Kalman's recursion, repeated until its gain has settled.
            for _ in range(STEADY):
                ahead = forward @ covariance @ forward.T + spread
                gain = ahead @ back.T @ np.linalg.inv(back @ ahead @ back.T + measured)
                covariance = (np.eye(3) - gain @ back) @ ahead
            lag = _exponential(slope * config.lag_s)
            rows.append(
                (
                    forward,
                    driven,
                    gain,
                    back,
                    driven_back,
                    lag[:3, :3],
                    lag[:3, 3],
                    covariance[2, 2] ** 0.5,
                )
            )
        return cls(*map(np.array, zip(*rows, strict=True)))


STILL_M_S = 0.01
"""Speed below which a path counts as a place to hold [m/s]."""

SURGE_MEMORY_S = 20.0
"""Time over which the longitudinal force is averaged [s]. A long body has little longitudinal drag:
0.2 to 0.5 N in a current of 5 cm/s, which is the error of a single estimate; the mean has a third
of that error."""

MAX_DAMPING = 8 / ACTION_S
"""Damping above which a filter would see no motion within an action [1/s]."""

STEADY = 600
"""Number of actions after which a filter's gain has settled."""


class ControlState(NamedTuple):
    """State of the controller between actions."""

    estimate: AxisEstimates
    """Error, its rate and the disturbance, axis by axis, in the axes of the path [m, rad; and per
    s, per s2]."""
    accelerations: Float[np.ndarray, "2 6"]
    """Accelerations of the fins in addition to the path's in the last two actions, the newest
    first."""
    heading: float
    """Angle by which the robot has turned from the path's heading into a current [rad]."""
    surge_n: float
    """Longitudinal force that was recently needed to hold the place [N]."""
    side: float
    """Side to which the robot turns into a current: 1 left, -1 right; 0 before the first turn."""


class MotionController:
    """Follows a path, or holds a place, by wrenches."""

    def __init__(self, robot: RobotConfig) -> None:
        config = robot.control
        self._config = config
        self.sway_reach_n = np.inf
        """Largest side force of the fins once one is dead [N]; with all fins the heading is
        kept."""
        self.dynamics = Dynamics.of(robot.body)
        self._rate = np.asarray(config.bandwidth_rad_s, float)
        self._damping = config.damping
        self._lag = config.lag_s / ACTION_S
        inertia = self.dynamics.inertia.diagonal()
        righting = self.dynamics.righting_nm_rad
        self._stiffness = np.array([0, 0, 0, righting, righting, 0]) / inertia
        noise = np.array(
            [[config.position_noise_m, config.velocity_noise_m_s]] * 3
            + [[config.attitude_noise_rad, config.rate_noise_rad_s]] * 3
        )
        self._damping_rate = np.minimum(self.dynamics.drag_linear / inertia, MAX_DAMPING)
        self._filter = AxisFilter.of(config, self._stiffness, self._damping_rate, noise)
        self._surge_noise_n = float(inertia[0] * self._filter.deviation[0])

    def init(self) -> ControlState:
        """Return the state before the first action, with nothing known."""
        return ControlState(np.zeros((6, 3)), np.zeros((2, 6)), heading=0.0, surge_n=0.0, side=0.0)

    def act(
        self,
        state: ControlState,
        seen: Sequence[np.ndarray],
        middle: PathPoint,
        now: PathPoint,
        ahead: PathPoint,
    ) -> tuple[ControlState, np.ndarray]:
        """Return the wrench in body axes for the next action [N, N m].

        `seen` contains positions ``(ticks, 3)``, attitudes ``(ticks, 4)`` and twists ``(ticks, 6)``
        of the last two actions; the targets are those in the middle of these, now, and in the
        middle of the action that begins.

        Raises:
            RunError: a number of the robot's state is not finite.
        """
        if not all(np.isfinite(each).all() for each in seen):
            raise RunError(
                "robot: its state holds numbers that are not finite; check what estimates it"
            )
        middle = _turned(middle, state.heading)
        ahead = _turned(ahead, state.heading)
        estimate = np.asarray(self.observed(state.estimate, state.accelerations, seen, middle))
        correction = self.corrected(estimate, state.accelerations)
        surge_n, side, heading = self._weathervane(state, estimate, now)
        state = state._replace(estimate=estimate, surge_n=surge_n, side=side, heading=heading)
        return state, np.asarray(self.needed(ahead) + self.dynamics.inertia @ correction)

    def observed(
        self,
        estimate: AxisEstimates,
        accelerations: Float[np.ndarray, "2 6"],
        seen: Sequence[np.ndarray],
        middle: PathPoint,
    ) -> AxisEstimates:
        """Return the estimate after observing two actions."""
        position = seen[0].mean(axis=0)
        twist = seen[2].mean(axis=0)
        # The quaternions are close to each other, so their mean only needs to be normalised.
        attitude = normalized((seen[1] * np.sign(seen[1] @ seen[1][-1])[:, None]).mean(axis=0))
        measured = np.stack(
            [path_error(middle, position, attitude), twist - path_twist(middle)], axis=1
        )
        f = self._filter
        acted = ((1 - self._lag) * accelerations[0] + self._lag * accelerations[1])[:, None]
        guess = np.einsum("aij,aj->ai", f.forward, estimate) + f.driven * acted
        expected = np.einsum("aij,aj->ai", f.back, guess) + f.driven_back * acted
        updated: AxisEstimates = guess + np.einsum("aij,aj->ai", f.gain, measured - expected)
        return updated

    def corrected(
        self, estimate: AxisEstimates, accelerations: Float[np.ndarray, "2 6"]
    ) -> SixVector:
        """Return the acceleration that corrects an error [m/s2, rad/s2]."""
        f = self._filter
        then = (
            np.einsum("aij,aj->ai", f.ahead, estimate) + f.driven_ahead * accelerations[0][:, None]
        )
        correction: SixVector = (
            -(self._rate**2) * then[:, 0] - 2 * self._damping * self._rate * then[:, 1] - then[:, 2]
        )
        return correction

    def _weathervane(
        self, state: ControlState, estimate: AxisEstimates, now: PathPoint
    ) -> tuple[float, float, float]:
        """Return surge force, side and heading of the next state; the heading turns into a current
        that comes too much from the side."""
        if np.linalg.norm(now.velocity) > STILL_M_S:
            return state.surge_n, state.side, state.heading
        surge, sway = -self._outside_wrench(estimate)[:2]
        surge_n = state.surge_n + ACTION_S / SURGE_MEMORY_S * (float(surge) - state.surge_n)
        excess = abs(sway) / (self._config.sway_part * self.sway_reach_n) - 1
        if excess <= 0:
            return surge_n, state.side, state.heading
        side = state.side
        # Below the noise the sign is a guess, but waiting would mean drifting off: the wrong
        # direction passes through abeam and ends just as well, only later. Only evidence above the
        # noise reverses the turn; otherwise a wavering robot would stay abeam.
        if not side or abs(surge_n) > self._surge_noise_n:
            side = float(np.sign(sway) * (np.sign(surge_n) or 1.0))
        turn_rad = self._config.weathervane_rad_s * ACTION_S * min(excess, 1.0)
        return surge_n, side, float(state.heading + side * turn_rad)

    def _outside_wrench(self, estimate: AxisEstimates) -> SixVector:
        """Return the wrench from outside in the axes of the path [N, N m].

        Each axis has its own filter, which models only the restoring moment and the drag of this
        axis. Through the inertia they also act on other axes: a roll moment balanced by the weight
        would look like sway.
        """
        error, rate, disturbance = estimate.T
        own = self._stiffness * error + self._damping_rate * rate
        inertia = self.dynamics.inertia
        wrench: SixVector = inertia @ disturbance + inertia.diagonal() * own - inertia @ own
        return wrench

    def acknowledge(self, state: ControlState, wrench: SixVector, ahead: PathPoint) -> ControlState:
        """Tell the observer which wrench the fins make in place of the requested one."""
        acceleration = self.dynamics.inverse @ (wrench - self.needed(_turned(ahead, state.heading)))
        return state._replace(accelerations=np.stack([acceleration, state.accelerations[0]]))

    def needed(self, target: PathPoint) -> SixVector:
        """Return the wrench that keeps the body on the path in still water, upright."""
        axes = matrix(target.attitude)
        twist = path_twist(target)
        velocity = twist[:3]
        turn = twist[3:]
        acceleration = six(
            target.acceleration @ axes - cross(turn, velocity), target.turning @ axes
        )
        d = self.dynamics
        needed: SixVector = (
            d.inertia @ acceleration
            - d.gyroscopic(twist)
            - d.drag(twist)
            - d.restoring(target.attitude)
        )
        return needed


def _turned(target: PathPoint, heading: float) -> PathPoint:
    if not heading:
        return target
    return target._replace(attitude=multiply(target.attitude, from_euler(0.0, 0.0, heading)))


def _exponential(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the matrix exponential by scaling and Taylor series, because NumPy lacks it."""
    small = matrix / 64
    result = np.eye(len(matrix))
    term = np.eye(len(matrix))
    for order in range(1, 10):
        term = term @ small / order
        result = result + term
    return np.asarray(np.linalg.matrix_power(result, 64))
