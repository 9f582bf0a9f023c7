"""The profile that a positioning drive follows, with coefficients identified from logs.

The trapezoidal profile itself is the drive's (`softfin.tank.drive`). CMA-ES finds the coefficients
with the smallest mean absolute error of the angle, so that a stroke that the profile cannot explain
has little influence.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S, AnyArray, Command, Log
from softfin.core.randomness import cma_es, named_generator
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, SegmentBatch, Table
from softfin.tank.drive import delayed, next_velocity

STEPS_PER_TICK = 2
"""Steps of the profile per tick, so that a corner between two ticks is reproduced within 5 ms."""

SEGMENTS = 48
TICKS = 300
"""Number and largest length [10 ms] of the log segments from which the coefficients are
identified."""

POPULATION = 16
GENERATIONS = 150
STARTS = 4


class ProfileState(NamedTuple):
    """Angle [rad] and velocity [rad/s] of the profile, and the commands in the queue, newest
    first."""

    angle: Float[AnyArray, ""]
    velocity: Float[AnyArray, ""]
    waiting: Command


def _coefficient(default: float) -> Any:
    return eqx.field(default=default, converter=lambda value: jnp.asarray(value, jnp.float32))


class Profile(eqx.Module):
    """A drive that follows its profile; by default an ideal one."""

    gain: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the measured to the commanded angle [-]."""
    zero: Float[Array, ""] = _coefficient(0.0)
    """Measured angle for a command of 0 [rad]."""
    delay: Float[Array, ""] = _coefficient(0.0)
    """Ticks from a command to the first one that obeys it, at most `MAX_DELAY` [10 ms]."""
    velocity_factor: Float[Array, ""] = _coefficient(1.0)
    """Ratio of the profile's velocity to the commanded velocity [-]."""
    velocity_limit: Float[Array, ""] = _coefficient(100.0)
    """Velocity that the profile never exceeds [rad/s]."""
    acceleration: Float[Array, ""] = _coefficient(100.0)
    """Acceleration when speeding up and braking [rad/s2]."""
    lag: Float[Array, ""] = _coefficient(0.0)
    """Angle by which the shaft is behind its profile, divided by its velocity [s]."""

    def start(self, motion: Motion, waiting: Command) -> ProfileState:
        """Return the state for a given motion and the commands of the last `MAX_DELAY` ticks,
        newest first."""
        return ProfileState(motion.angle + self.lag * motion.velocity, motion.velocity, waiting)

    def step(self, state: ProfileState, command: Command) -> tuple[ProfileState, Command]:
        """Advance by one tick under a new command; also returns the command being obeyed, in the
        angle scale of the log."""
        queue = jax.tree.map(jnp.append, command, state.waiting)
        obeyed = delayed(queue, self.delay)
        speed = jnp.minimum(self.velocity_factor * obeyed.velocity, self.velocity_limit)
        target = Command(self.gain * obeyed.angle + self.zero, speed)
        seconds = TICK_S / STEPS_PER_TICK
        angle = jnp.asarray(state.angle)
        velocity = jnp.asarray(state.velocity)
        # The trapezoidal rule is exact while the acceleration is constant.
        for _ in range(STEPS_PER_TICK):
            after = next_velocity(angle, velocity, target, self.acceleration, seconds)
            angle = angle + seconds * (velocity + after) / 2
            velocity = after
        waiting = jax.tree.map(lambda channel: channel[:-1], queue)
        return ProfileState(angle, velocity, waiting), target

    def motion(self, state: ProfileState) -> Motion:
        """Return the motion of the shaft that follows the profile."""
        return Motion(state.angle - self.lag * state.velocity, state.velocity)


def identify(logs: Sequence[Log], seed: int) -> tuple[Profile, float]:
    """Find the coefficients; also return their mean absolute error of the angle [rad]."""
    ticks = min(TICKS, max(log.rows for log in logs) - MAX_DELAY - 1)
    segments = Table.of(logs, ticks).draw(jax.random.key(seed), SEGMENTS, ticks)
    errors = jax.jit(jax.vmap(lambda coded: _error(_profile(coded), segments)))
    speed = max(np.abs(log.reading.velocity).max() for log in logs)
    change = np.abs(np.concatenate([np.diff(log.reading.velocity) for log in logs])) / TICK_S
    steep = np.quantile(change[change > 0.1 * change.max()], 0.8)
    results = []
    for start in range(STARTS):
        # An ideal drive with a delay of two or three ticks, no faster than in the logs. The error
        # has local minima at many delays: one search in five ends in a wrong one.
        guess = np.array([0.0, 0.0, 3.0 - start % 2, 0.0, 5 * np.log(speed), np.log(steep), 0.0])
        random = named_generator(seed, f"identify/{start}")
        sizes = {"popsize": POPULATION, "maxiter": GENERATIONS}
        search = cma_es(guess, 0.2 * (1 + start // 2), random, **sizes, tolx=1e-6, tolfun=1e-8)
        while not search.stop():
            asked = search.ask()
            search.tell(
                asked,
                np.asarray(errors(jnp.asarray(np.stack(asked), jnp.float32)), np.float64).tolist(),
            )
        results.append(search.result)
    best = min(results, key=lambda result: result.fbest)
    return _profile(jnp.asarray(best.xbest, jnp.float32)), float(best.fbest)


def _profile(coded: Float[Array, "coefficients"]) -> Profile:
    """Decode a point of the search: gains, limits and acceleration are logarithms; delay and lag
    are absolute values."""
    # The limit moves in small steps: above all commands it has no effect, and a search would get
    # lost there.
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
    def one(segment: SegmentBatch) -> Float[Array, ""]:
        def step(state: ProfileState, command: Command) -> tuple[ProfileState, AnyArray]:
            state, _ = profile.step(state, command)
            return state, profile.motion(state).angle

        before: Motion = jax.tree.map(lambda x: x[0], segment.motion)
        _, angle = jax.lax.scan(step, profile.start(before, segment.waiting), segment.commands)
        return jnp.mean(jnp.abs(angle - segment.motion.angle[1:]))

    return jnp.mean(jax.vmap(one)(segments))
