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
from softfin.robot.fin_driver import FinGaits
from softfin.robot.motion_control import SEEN_ACTIONS, MotionController
from softfin.robot.paths import PathPoint, twist_of
from softfin.robot.residual_policy import LATER_S, ResidualPolicy
from softfin.robot.rotation import cross, from_vector, inverse, matrix, multiply, to_vector
from softfin.robot.trial import NoiseConfig

STEPS = 4
"""Steps of an action. In the first three the forces of the action before act: fins follow by a quarter of a second."""

STEP_S = 1 / (STEPS * ACTION_RATE_HZ)

BEFORE, AFTER = SEEN_ACTIONS * STEPS // 2, round(max(LATER_S) / STEP_S)
"""Steps before and after now at which the path is looked at."""

SMALL_N = 0.05
"""A force below this has no steady direction."""

SWUNG_ASIDE = 2.0
"""Deviation of a fin's force, in both directions, in an action in which it changes by 1 N [N]: 1.3 to 2.7 in the tank,
by trials with small and great changes."""


class Seen(NamedTuple):
    """The estimate of the state in the last two actions."""

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
    seen: Seen
    estimate: Float[AnyArray, "6 3"]
    accelerations: Float[AnyArray, "2 6"]
    current: Float[AnyArray, "3"]
    """Velocity of the water in world axes [m/s]."""


class Outcome(NamedTuple):
    """Errors in each step of an action."""

    position: Float[AnyArray, "steps 3"]
    """Place relative to the path's, in its axes [m]."""
    attitude: Float[AnyArray, "steps 3"]
    """Vector of the rotation from the path's attitude to the robot's [rad]."""


class AveragedRobot:
    """A robot, its fins and its motion controller, action by action. Pure; one robot, `vmap` adds robots."""

    def __init__(self, robot: RobotConfig, gaits: Sequence[FinGaits], noise: NoiseConfig) -> None:
        self.controller, self.gaits = MotionController(robot), gaits
        self.dynamics = self.controller.dynamics
        self._matrix, self._smoothing = robot.matrix(), robot.allocation.smoothing
        self._share = np.linalg.pinv(self._matrix)
        self._reach = np.array([each.reach for each in gaits])
        self._places = np.array([fin.position_m for fin in robot.fins.values()])
        self._axes = np.array([fin.axes() for fin in robot.fins.values()])
        self._force_noise = self.dynamics.inertia @ np.diag(robot.control.force_noise)
        self._noise = np.repeat([noise.position_m, noise.attitude_rad, noise.velocity_m_s, noise.rate_rad_s], 3)
        self._forget = float(np.exp(-STEP_S / noise.memory_s))

    def init(self, key: PRNGKeyArray, body: BodyState, current: Float[AnyArray, "3"]) -> AveragedState:
        """Return a robot in that state, whose controller knows nothing yet."""
        noise = self._noise * jax.random.normal(key, (12,))
        seen = Seen(*(jnp.repeat(part[None], SEEN_ACTIONS * STEPS, axis=0) for part in _estimated(body, noise)))
        fins = jnp.zeros((len(self.gaits), 2))
        return AveragedState(body, fins, jnp.zeros(6), noise, seen, jnp.zeros((6, 3)), jnp.zeros((2, 6)), current)

    def act(
        self, state: AveragedState, policy: ResidualPolicy | None, path: PathPoint, push: SixVector,
        key: PRNGKeyArray,
    ) -> tuple[AveragedState, Outcome]:  # fmt: skip
        """Take one action.

        `path` has rows from `BEFORE` steps before now to `AFTER` steps after; `push` is a wrench from outside [N, N m].
        """
        ahead = _at(path, BEFORE + STEPS // 2)
        estimate = self.controller.observed(state.estimate, state.accelerations, state.seen, _at(path, 0))
        correction = self.controller.corrected(estimate, state.accelerations)
        if policy is not None:
            points = [_at(path, BEFORE + round(seconds / STEP_S)) for seconds in (0.0, *LATER_S)]
            correction = correction + policy.act(estimate, state.accelerations, points)
        needed = self.controller.needed(ahead)
        asked = (self._share @ (needed + self.dynamics.inertia @ correction)).reshape(-1, 2)
        sizes = jnp.sqrt((asked**2).sum(axis=1) + SMALL_N**2)
        within = asked * jnp.minimum(1, self._reach / sizes)[:, None]
        forces = self._smoothing * state.forces + (1 - self._smoothing) * within
        accelerated = self.dynamics.inverse @ (self._matrix @ forces.reshape(-1) - needed)
        twist = twist_of(ahead)
        key, *others = jax.random.split(key, 3)
        # Fins that swing round to another force push aside.
        swung = jnp.sqrt(((forces - state.forces) ** 2).sum(axis=1, keepdims=True) + SMALL_N**2) - SMALL_N
        aside = SWUNG_ASIDE * swung * jax.random.normal(others[0], forces.shape)
        push = push + self._force_noise @ jax.random.normal(others[1], (6,)) + self._matrix @ aside.reshape(-1)
        # In the last step alone the new forces act.
        is_last = jnp.arange(STEPS) == STEPS - 1
        targets = PathPoint(*(part[BEFORE + 1 : BEFORE + 1 + STEPS] for part in path))

        def advance(now: tuple[BodyState, AnyArray], step: tuple[Any, ...]) -> tuple[Any, Any]:
            (body, noise), (last, draw, target) = now, step
            acting, expected = jnp.where(last, forces, state.forces), jnp.where(last, twist, state.path_twist)
            wrench = self._wrench(acting, expected, body, state.current)
            body = self.dynamics.step(body, wrench + push, state.current, STEP_S)
            noise = self._forget * noise + (1 - self._forget**2) ** 0.5 * self._noise * draw
            error = (body.position - target.position) @ matrix(target.attitude)
            turned = to_vector(multiply(inverse(target.attitude), body.attitude))
            return (body, noise), (Outcome(error, turned), Seen(*_estimated(body, noise)))

        draws = jax.random.normal(key, (STEPS, 12))
        (body, noise), (outcome, newest) = jax.lax.scan(advance, (state.body, state.noise), (is_last, draws, targets))
        after = state._replace(
            body=body, forces=forces, path_twist=twist, noise=noise, estimate=estimate,
            seen=Seen(*(jnp.concatenate([a[STEPS:], b]) for a, b in zip(state.seen, newest, strict=True))),
            accelerations=jnp.stack([accelerated, state.accelerations[0]]),
        )  # fmt: skip
        return after, outcome

    def _wrench(
        self, forces: Float[AnyArray, "fins 2"], expected: SixVector, body: BodyState, current: Float[AnyArray, "3"]
    ) -> SixVector:
        """Return the wrench of the fins: they have made up for an expected twist, and lose force by the true one."""
        unexpected = self.dynamics.relative_twist(body, current) - expected
        left = []
        for place, axes, gaits, force in zip(self._places, self._axes, self.gaits, forces, strict=True):
            velocity = (unexpected[:3] + cross(unexpected[3:], place)) @ axes
            size = jnp.sqrt(force @ force + SMALL_N**2)
            along = velocity @ force / size**2 * force
            first, across = (jnp.interp(size, gaits.force, loss) for loss in gaits.stream_loss.T)
            left.append(force - first * along - across * (velocity - along))
        wrench: SixVector = self._matrix @ jnp.concatenate(left)
        return wrench


def _estimated(body: BodyState, noise: Float[AnyArray, "12"]) -> tuple[AnyArray, AnyArray, AnyArray]:
    return body.position + noise[:3], multiply(body.attitude, from_vector(noise[3:6])), body.twist + noise[6:]


def _at(path: PathPoint, row: int) -> PathPoint:
    return PathPoint(*(part[row] for part in path))
