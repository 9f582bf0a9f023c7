"""The trapezoidal profile of a positioning drive, with coefficients identified from logs.

The equations of the profile are in `softfin.tank.drive`. CMA-ES minimizes the mean absolute angle
error, because strokes that the profile cannot explain then have little influence.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.compilation import map_in_threads
from softfin.core.quantities import TICK_S, AnyArray, Command, Log
from softfin.core.randomness import cma_es, named_generator
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, SegmentBatch, Table
from softfin.tank.drive import delay_weights, delayed, next_velocity

STEPS_PER_TICK = 2
"""Number of integration steps per tick; the times of profile corners between ticks are accurate to
5 ms."""

SEGMENTS = 48
"""Number of log segments from which the coefficients are identified."""

TICKS = 300
"""Maximum length of these segments [10 ms]."""

POPULATION = 16
GENERATIONS = 150
STARTS = 4
"""Number of searches with different initial values; the best result is used."""


class ProfileState(NamedTuple):
    """State of the profile between ticks."""

    motion: Motion
    """Motion of the profile, without lag."""
    waiting: Command
    """Commands of the last `MAX_DELAY` ticks, newest first."""


def _coefficient(default: float) -> Any:
    return eqx.field(default=default, converter=lambda value: jnp.asarray(value, jnp.float32))


class Profile(eqx.Module):
    """Coefficients of a drive that follows its profile; by default an ideal drive."""

    gain: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the measured to the commanded angle [-]."""
    zero: Float[Array, ""] = _coefficient(0.0)
    """Measured angle for a command of 0 [rad]."""
    delay: Float[Array, ""] = _coefficient(0.0)
    """Delay from a command to its first effect, at most `MAX_DELAY` [10 ms]."""
    velocity_factor: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the profile velocity to the commanded velocity [-]."""
    velocity_limit: Float[Array, ""] = _coefficient(100.0)
    """Maximum velocity of the profile [rad/s]."""
    acceleration: Float[Array, ""] = _coefficient(100.0)
    """Magnitude of acceleration and deceleration [rad/s2]."""
    lag: Float[Array, ""] = _coefficient(0.0)
    """Time by which the shaft lags behind its profile [s]."""

    def start(self, motion: Motion, waiting: Command) -> ProfileState:
        """Return the state for a motion and the commands of the last `MAX_DELAY` ticks, newest
        first."""
        ahead = motion._replace(angle=motion.angle + self.lag * motion.velocity)
        return ProfileState(ahead, waiting)

    def step(self, state: ProfileState, command: Command) -> tuple[ProfileState, Command]:
        """Advance by one tick under a new command; also return the command in effect, converted to
        a measured angle and a profile velocity."""
        queue = jax.tree.map(jnp.append, command, state.waiting)
        target = self.target(delayed(queue, self.delay))
        after = self.follow(state.motion, target)
        waiting = jax.tree.map(lambda channel: channel[:-1], queue)
        return ProfileState(after, waiting), target

    def target(self, obeyed: Command) -> Command:
        """Convert the command in effect to a measured angle and a profile velocity."""
        speed = jnp.minimum(self.velocity_factor * obeyed.velocity, self.velocity_limit)
        return Command(self.gain * obeyed.angle + self.zero, speed)

    def follow(self, before: Motion, target: Command) -> Motion:
        """Advance the motion of the profile by one tick."""
        seconds = TICK_S / STEPS_PER_TICK
        angle = jnp.asarray(before.angle)
        velocity = jnp.asarray(before.velocity)
        # angle' = angle + h (v + v') / 2; this trapezoidal rule is exact while the acceleration is
        # constant.
        for _ in range(STEPS_PER_TICK):
            after = next_velocity(angle, velocity, target, self.acceleration, seconds)
            angle = angle + seconds * (velocity + after) / 2
            velocity = after
        return Motion(angle, velocity)

    def shaft(self, profile: Motion) -> Motion:
        """Return the motion of the shaft that follows the profile."""
        return profile._replace(angle=profile.angle - self.lag * profile.velocity)


def identify(logs: Sequence[Log], seed: int) -> tuple[Profile, float]:
    """Identify the coefficients from logs; also return the mean absolute angle error [rad]."""
    ticks = min(TICKS, max(log.rows for log in logs) - MAX_DELAY - 1)
    segments = Table.of(logs, ticks).draw(jax.random.key(seed), SEGMENTS, ticks)
    errors = jax.jit(jax.vmap(lambda coded: _error(_profile(coded), segments)))
    speed = max(np.abs(log.reading.velocity).max() for log in logs)
    change = np.abs(np.concatenate([np.diff(log.reading.velocity) for log in logs])) / TICK_S
    # Initial acceleration: a high percentile of the values that are not merely noise at constant
    # velocity.
    steep = np.quantile(change[change > 0.1 * change.max()], 0.8)

    def search(start: int) -> Any:
        # Start from an ideal drive with a delay of 2 or 3 ticks and the maximum velocity of the
        # logs. The error has local minima at many delays, and one search in five ends at a wrong
        # delay. Several searches are therefore run, the last two with a larger initial step size.
        guess = np.array([0.0, 0.0, 3.0 - start % 2, 0.0, 5 * np.log(speed), np.log(steep), 0.0])
        random = named_generator(seed, f"identify/{start}")
        sizes = {"popsize": POPULATION, "maxiter": GENERATIONS}
        evolution = cma_es(guess, 0.2 * (1 + start // 2), random, **sizes, tolx=1e-6, tolfun=1e-8)
        while not evolution.stop():
            points = evolution.ask()
            point_errors = errors(np.stack(points).astype(np.float32))
            evolution.tell(points, np.asarray(point_errors, np.float64).tolist())
        return evolution.result

    results = map_in_threads(search, range(STARTS))
    best = min(results, key=lambda result: result.fbest)
    return _profile(jnp.asarray(best.xbest, jnp.float32)), float(best.fbest)


@jax.jit
def _profile(coded: Float[Array, "coefficients"]) -> Profile:
    """Convert a point of the search to coefficients.

    The search uses the logarithms of gain, factor, limit and acceleration, which must be positive,
    and the absolute values of delay and lag.
    """
    # The factors set the step size of each coefficient. The step size of the velocity limit is
    # small, because a limit above all commands has no effect and would mislead the search.
    gain, zero, delay, factor, limit, acceleration, lag = coded
    return Profile(
        jnp.exp(0.1 * gain),
        0.05 * zero,
        jnp.minimum(jnp.abs(delay), MAX_DELAY),
        jnp.exp(0.2 * factor),
        jnp.exp(0.2 * limit),
        jnp.exp(acceleration),
        0.01 * jnp.abs(lag),
    )


def _error(profile: Profile, segments: SegmentBatch) -> Float[Array, ""]:
    """Return the mean absolute angle error in free runs over the segments [rad]."""
    # Rows of the commands in the queue at each tick, newest first.
    ticks = segments.commands.angle.shape[1]
    rows = MAX_DELAY + jnp.arange(ticks)[:, None] - jnp.arange(MAX_DELAY + 1)
    weights = delay_weights(MAX_DELAY + 1, profile.delay)

    def one(segment: SegmentBatch) -> Float[Array, ""]:
        # The delay is applied to all commands before the loop over the ticks, because one large
        # product is faster than a queue of commands within the loop.
        oldest_first = jax.tree.map(jnp.flip, segment.waiting)
        history = jax.tree.map(lambda *x: jnp.concatenate(x), oldest_first, segment.commands)
        targets = profile.target(jax.tree.map(lambda channel: channel[rows] @ weights, history))

        def step(motion: Motion, target: Command) -> tuple[Motion, AnyArray]:
            motion = profile.follow(motion, target)
            return motion, profile.shaft(motion).angle

        before: Motion = jax.tree.map(lambda x: x[0], segment.motion)
        start = profile.start(before, segment.waiting)
        _, angle = jax.lax.scan(step, start.motion, targets)
        return jnp.mean(jnp.abs(angle - segment.motion.angle[1:]))

    return jnp.mean(jax.vmap(one)(segments))
