"""A robot whose fins make their mean forces, late and less in moving water: quick enough to train a policy in.

Strokes are left out, and with them allocation beyond reach, bracing and phases: a fin's force is the one that the
pseudo-inverse asks for, within its reach. What fins make beside it is noise, action by action, of the size that the
motion controller takes it to have. The controller is the robot's own.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.quantities import AnyArray
from softfin.robot.description import RobotConfig
from softfin.robot.dynamics import BodyState, SixVector
from softfin.robot.fin_driver import SMALL_N, FinGaits
from softfin.robot.motion_control import SEEN_ACTIONS, MotionController
from softfin.robot.noise import NoiseConfig, estimated
from softfin.robot.paths import PathPoint, error_of, twist_of
from softfin.robot.residual_policy import LATER_S, ResidualPolicy
from softfin.robot.rotation import from_vector, matrix, multiply, normalized

STEPS = 4
"""Steps of an action. In the first three the forces of the action before act: fins follow by a quarter of a second."""

STEP_S = 1 / (STEPS * ACTION_RATE_HZ)

BEFORE, AFTER = SEEN_ACTIONS * STEPS // 2, round(max(LATER_S) / STEP_S)
"""Steps before and after now at which the path is looked at."""

SWUNG_ASIDE = 2.0
"""Deviation of a fin's force, in both directions, in an action in which it changes by 1 N [N]: 1.3 to 2.7 in the tank,
by trials with small and great changes."""


class EstimateHistory(NamedTuple):
    """Estimate of the state in the last two actions."""

    position: Float[AnyArray, "steps 3"]
    attitude: Float[AnyArray, "steps 4"]
    twist: Float[AnyArray, "steps 6"]


class AveragedState(NamedTuple):
    """State of robot, controller and surroundings between two actions."""

    body: BodyState
    forces: Float[AnyArray, "fins 2"]
    """Mean force that each fin was asked for in the last action, in its own axes [N]."""
    path_twist: SixVector
    """Twist for which the fins made up in the last action [m/s, rad/s]."""
    noise: Float[AnyArray, "12"]
    """Errors of the estimate of position, attitude and twist."""
    history: EstimateHistory
    estimate: Float[AnyArray, "6 3"]
    accelerations: Float[AnyArray, "2 6"]
    current: Float[AnyArray, "3"]
    """Velocity of the water in world axes [m/s]."""


class AveragedRobot:
    """A robot, its fins and its motion controller, action by action. Pure; one robot, `vmap` adds robots."""

    def __init__(self, robot: RobotConfig, gaits: Sequence[FinGaits], noise: NoiseConfig) -> None:
        self.controller, self.gaits = MotionController(robot), gaits
        self.dynamics = self.controller.dynamics
        self._matrix, self._smoothing = robot.matrix(), robot.allocation.smoothing
        self._share = np.linalg.pinv(self._matrix)
        self._reach = np.array([each.reach for each in gaits])
        self._mounts = robot.mounts()
        self._force_noise = self.dynamics.inertia @ np.diag(robot.control.force_noise)
        self._noise, (self._kept, self._new) = noise.deviations(), noise.decay(STEP_S)

    def init(self, key: PRNGKeyArray, body: BodyState, current: Float[AnyArray, "3"], path: PathPoint) -> AveragedState:
        """Return a robot that has come along at its twist, with the forces that its path needs.

        Its controller knows nothing of disturbances yet; `path` is as in `act`.
        """
        noise = self._noise * jax.random.normal(key, (12,))
        velocity, turn = matrix(body.attitude) @ body.twist[:3], body.twist[3:]

        def before(seconds: Float[AnyArray, ""]) -> BodyState:
            attitude = multiply(body.attitude, from_vector(-seconds * turn))
            return BodyState(body.position - seconds * velocity, attitude, body.twist)

        states = jax.vmap(before)(STEP_S * jnp.arange(SEEN_ACTIONS * STEPS - 1.0, -1.0, -1.0))
        history = EstimateHistory(*estimated(states, jnp.broadcast_to(noise, (SEEN_ACTIONS * STEPS, 12))))
        now = _at(path, BEFORE)
        forces = self._within(self._share @ self.controller.needed(now))
        return AveragedState(
            body, forces, twist_of(now), noise, history, jnp.zeros((6, 3)), jnp.zeros((2, 6)), current
        )  # fmt: skip

    def _within(self, forces: Float[AnyArray, "columns"]) -> Float[AnyArray, "fins 2"]:
        """Shorten forces to each fin's reach."""
        rows = forces.reshape(-1, 2)
        within: Float[AnyArray, "fins 2"] = rows * jnp.minimum(1, self._reach / _size(rows))[:, None]
        return within

    def act(
        self, state: AveragedState, policy: ResidualPolicy | None, path: PathPoint, push: SixVector,
        key: PRNGKeyArray,
    ) -> tuple[AveragedState, Float[AnyArray, "steps 6"]]:  # fmt: skip
        """Take one action, and return the error from the path in each of its steps [m, rad].

        `path` has rows from `BEFORE` steps before now to `AFTER` steps after; `push` is a wrench from outside [N, N m].
        """
        ahead = _at(path, BEFORE + STEPS // 2)
        # The mean of what was seen is that of half a step after the path's first row.
        middle = PathPoint(*(part[:2].mean(axis=0) for part in path))
        middle = middle._replace(attitude=normalized(middle.attitude))
        estimate = self.controller.observed(state.estimate, state.accelerations, state.history, middle)
        correction = self.controller.corrected(estimate, state.accelerations)
        if policy is not None:
            points = [_at(path, BEFORE + round(seconds / STEP_S)) for seconds in (0.0, *LATER_S)]
            correction = correction + policy.act(estimate, state.accelerations, points)
        needed = self.controller.needed(ahead)
        within = self._within(self._share @ (needed + self.dynamics.inertia @ correction))
        forces = self._smoothing * state.forces + (1 - self._smoothing) * within
        accelerated = self.dynamics.inverse @ (self._matrix @ forces.reshape(-1) - needed)
        twist = twist_of(ahead)
        key, *others = jax.random.split(key, 3)
        # Fins that swing round to another force push aside.
        swung = _size(forces - state.forces) - SMALL_N
        aside = SWUNG_ASIDE * swung[:, None] * jax.random.normal(others[0], forces.shape)
        push = push + self._force_noise @ jax.random.normal(others[1], (6,)) + self._matrix @ aside.reshape(-1)
        # In the last step alone the new forces act.
        is_last = jnp.arange(STEPS) == STEPS - 1
        targets = PathPoint(*(part[BEFORE + 1 : BEFORE + 1 + STEPS] for part in path))

        def advance(now: tuple[BodyState, AnyArray], step: tuple[Any, ...]) -> tuple[Any, Any]:
            (body, noise), (last, draw, target) = now, step
            acting, expected = jnp.where(last, forces, state.forces), jnp.where(last, twist, state.path_twist)
            wrench = self._wrench(acting, expected, body, state.current)
            body = self.dynamics.step(body, wrench + push, state.current, STEP_S)
            noise = self._kept * noise + self._new * self._noise * draw
            return (body, noise), (error_of(target, body.position, body.attitude), estimated(body, noise))

        draws = jax.random.normal(key, (STEPS, 12))
        (body, noise), (errors, newest) = jax.lax.scan(advance, (state.body, state.noise), (is_last, draws, targets))
        after = state._replace(
            body=body, forces=forces, path_twist=twist, noise=noise, estimate=estimate,
            history=EstimateHistory(
                *(jnp.concatenate([a[STEPS:], b]) for a, b in zip(state.history, newest, strict=True))
            ),
            accelerations=jnp.stack([accelerated, state.accelerations[0]]),
        )  # fmt: skip
        return after, errors

    def _wrench(
        self, forces: Float[AnyArray, "fins 2"], expected: SixVector, body: BodyState, current: Float[AnyArray, "3"]
    ) -> SixVector:
        """Return the wrench of the fins: they have made up for an expected twist, and lose force by the true one."""
        unexpected = self.dynamics.relative_twist(body, current) - expected
        fins = zip(self.gaits, forces, self._mounts.velocities(unexpected), strict=True)
        wrench: SixVector = self._matrix @ jnp.concatenate([f - gaits.lost(f, velocity) for gaits, f, velocity in fins])
        return wrench


def _size(forces: Float[AnyArray, "fins 2"]) -> Float[AnyArray, "fins"]:
    """Return lengths of forces, which have a derivative at 0, too [N]."""
    return jnp.sqrt((forces**2).sum(axis=1) + SMALL_N**2)


def _at(path: PathPoint, row: int) -> PathPoint:
    return PathPoint(*(part[row] for part in path))
