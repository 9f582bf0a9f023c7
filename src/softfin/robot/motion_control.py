"""Motion control in 6 degrees of freedom: computed torque along a path, with one observer per axis.
NumPy only.

The wrench needed to follow the path is computed from the model of the body. Errors are corrected by
proportional and derivative action. A Kalman filter for each axis estimates the error, its rate and
a constant disturbance, which is compensated. The filter uses the allocated wrench and not the
requested one, which prevents wind-up (Fossen 2021, ch. 13 and 15; Sariyildiz, Oboe and Ohnishi
2020). Path axes are approximated by body axes, so the body must stay within about one radian of the
path's attitude.

Fins stroke at half the action rate. Errors are therefore averaged over two actions, in which
strokes cancel: sampled once per action, a stroke would look like a constant error.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import PAPER_CLOCK
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

ACTION_S = 1 / PAPER_CLOCK.rate_hz

SEEN_ACTIONS = 2
"""Number of actions over which errors are averaged: one full stroke period."""


AxisEstimates = Float[np.ndarray, "6 3"]
AxisTransitions = Float[np.ndarray, "6 3 3"]


class AxisFilter(NamedTuple):
    """Kalman filters of the six axes, with state x = (error, its rate, acceleration due to
    disturbances) and input u = acceleration due to the fins."""

    forward: AxisTransitions
    """State transition from one action to the next."""
    driven: AxisEstimates
    gain: Float[np.ndarray, "6 3 2"]
    """Steady-state gain of the Kalman filter."""
    back: Float[np.ndarray, "6 2 3"]
    """Map from the current state to the mean error and rate over the last two actions."""
    driven_back: Float[np.ndarray, "6 2"]
    ahead: AxisTransitions
    """State transition to the time at which new forces take effect."""
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
        """Build the filters from the stiffness [1/s2] and damping [1/s] of the body itself, and the
        noise of the measured error and rate."""
        rows = []
        for axis in range(6):
            # d/dt (error, rate, disturbance, u): the body's own spring and damper, driven by the
            # disturbance and the fins. Disturbance and u are constant within an action.
            slope = np.array(
                [[0, 1, 0, 0], [-stiffness[axis], -damping[axis], 1, 1], [0, 0, 0, 0], [0, 0, 0, 0]]
            )
            step = _exponential(slope * ACTION_S)
            # The mean over the last two actions approximates the state in their middle, one action
            # ago.
            half = np.linalg.inv(step)
            forward = step[:3, :3]
            driven = step[:3, 3]
            back = half[:2, :3]
            driven_back = half[:2, 3]
            # Variance of the random walk after one action.
            walk = config.disturbance[axis] ** 2 * ACTION_S
            spread = np.outer(driven, driven) * config.force_noise[axis] ** 2
            spread[2, 2] += walk
            measured = np.diag(noise[axis] ** 2)
            covariance = np.eye(3)
            # Kalman recursion, repeated until its gain has converged.
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
"""Speed below which a path counts as station keeping [m/s]."""

SURGE_MEMORY_S = 20.0
"""Averaging time of the longitudinal force [s]. A long body has little longitudinal drag, 0.2 to
0.5 N in a current of 5 cm/s. A single estimate has an error of that size; the error of the mean is
a third of that."""

MAX_DAMPING = 8 / ACTION_S
"""Upper limit of the damping in the filters [1/s]; with more, motion would decay within one
action."""

STEADY = 600
"""Number of actions after which a filter's gain has converged."""


class ControlState(NamedTuple):
    """State of the controller between actions."""

    estimate: AxisEstimates
    """Error, its rate and the disturbance for each axis, in path axes [m, m/s, m/s2; rad, rad/s,
    rad/s2]."""
    accelerations: Float[np.ndarray, "2 6"]
    """Accelerations due to the fins, in addition to the path's, in the last two actions, latest
    first."""
    heading: float
    """Angle by which the robot has turned away from the path's heading into a current [rad]."""
    surge_n: float
    """Recent mean of the longitudinal force needed for station keeping [N]."""
    side: float
    """Direction in which the robot turns into a current: 1 left, -1 right; 0 before the first
    turn."""


class MotionController:
    """Controller that computes wrenches to follow a path or to keep station."""

    def __init__(self, robot: RobotConfig) -> None:
        config = robot.control
        self._config = config
        self.sway_reach_n = np.inf
        """Maximum side force of the remaining fins after one has died [N]; infinite while all fins
        work, so that the heading is kept."""
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
        """Return the initial state, with all estimates zero."""
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
        of the last two actions; `middle`, `now` and `ahead` are the targets in the middle of these
        actions, now, and in the middle of the next action.

        Raises:
            RunError: the robot's state is not finite.
        """
        if not all(np.isfinite(each).all() for each in seen):
            raise RunError("robot: its state is not finite; check the state estimator")
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
        """Return the estimate updated with the observation of two actions."""
        position = seen[0].mean(axis=0)
        twist = seen[2].mean(axis=0)
        # The quaternions are close to each other, so their normalised mean is sufficient; align
        # their signs first, because q and -q are the same attitude.
        attitude = normalized((seen[1] * np.sign(seen[1] @ seen[1][-1])[:, None]).mean(axis=0))
        measured = np.stack(
            [path_error(middle, position, attitude), twist - path_twist(middle)], axis=1
        )
        f = self._filter
        # Forces lag the commands by `lag_s`, so the previous action's acceleration acts in the
        # first part of an action.
        acted = ((1 - self._lag) * accelerations[0] + self._lag * accelerations[1])[:, None]
        guess = np.einsum("aij,aj->ai", f.forward, estimate) + f.driven * acted
        expected = np.einsum("aij,aj->ai", f.back, guess) + f.driven_back * acted
        updated: AxisEstimates = guess + np.einsum("aij,aj->ai", f.gain, measured - expected)
        return updated

    def corrected(
        self, estimate: AxisEstimates, accelerations: Float[np.ndarray, "2 6"]
    ) -> SixVector:
        """Return the acceleration that corrects the estimated error [m/s2, rad/s2]."""
        f = self._filter
        then = (
            np.einsum("aij,aj->ai", f.ahead, estimate) + f.driven_ahead * accelerations[0][:, None]
        )
        # -(w^2 e + 2 zeta w de/dt) - d, with the state predicted to the time at which the new
        # forces take effect.
        correction: SixVector = (
            -(self._rate**2) * then[:, 0] - 2 * self._damping * self._rate * then[:, 1] - then[:, 2]
        )
        return correction

    def _weathervane(
        self, state: ControlState, estimate: AxisEstimates, now: PathPoint
    ) -> tuple[float, float, float]:
        """Return surge force, side and heading of the next state; the heading turns into the
        current if the side force becomes too large."""
        if np.linalg.norm(now.velocity) > STILL_M_S:
            return state.surge_n, state.side, state.heading
        surge, sway = -self._outside_wrench(estimate)[:2]
        # First-order low-pass filter.
        surge_n = state.surge_n + ACTION_S / SURGE_MEMORY_S * (float(surge) - state.surge_n)
        excess = abs(sway) / (self._config.sway_part * self.sway_reach_n) - 1
        if excess <= 0:
            return surge_n, state.side, state.heading
        side = state.side
        # Below the noise level the sign is a guess, but waiting would mean drifting away: turning
        # in the wrong direction passes through abeam and also reaches the goal, just later. The
        # turn is reversed only if the force exceeds the noise, otherwise an undecided robot would
        # stay abeam.
        if not side or abs(surge_n) > self._surge_noise_n:
            side = float(np.sign(sway) * (np.sign(surge_n) or 1.0))
        turn_rad = self._config.weathervane_rad_s * ACTION_S * min(excess, 1.0)
        return surge_n, side, float(state.heading + side * turn_rad)

    def _outside_wrench(self, estimate: AxisEstimates) -> SixVector:
        """Return the estimated external wrench in path axes [N, N m].

        Each filter models only the restoring moment and the drag of its own axis, but the inertia
        couples them to other axes. Without this correction, a roll moment balanced by the weight
        would look like sway.
        """
        error, rate, disturbance = estimate.T
        own = self._stiffness * error + self._damping_rate * rate
        inertia = self.dynamics.inertia
        wrench: SixVector = inertia @ disturbance + inertia.diagonal() * own - inertia @ own
        return wrench

    def acknowledge(self, state: ControlState, wrench: SixVector, ahead: PathPoint) -> ControlState:
        """Update the state with the allocated wrench, which may differ from the requested one."""
        acceleration = self.dynamics.inverse @ (wrench - self.needed(_turned(ahead, state.heading)))
        return state._replace(accelerations=np.stack([acceleration, state.accelerations[0]]))

    def needed(self, target: PathPoint) -> SixVector:
        """Return the wrench that keeps the upright body on the path in still water."""
        axes = matrix(target.attitude)
        twist = path_twist(target)
        velocity = twist[:3]
        turn = twist[3:]
        # In rotating axes: dv/dt = R' a - omega x v.
        acceleration = six(
            target.acceleration @ axes - cross(turn, velocity), target.turning @ axes
        )
        d = self.dynamics
        # Inverse dynamics: M dv/dt = wrench + gyroscopic + drag + restoring.
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
    """Return the matrix exponential, by scaling and squaring of a Taylor series; NumPy does not
    have it."""
    # exp(A) = exp(A / 64)^64.
    small = matrix / 64
    result = np.eye(len(matrix))
    term = np.eye(len(matrix))
    for order in range(1, 10):
        term = term @ small / order
        result = result + term
    return np.asarray(np.linalg.matrix_power(result, 64))
