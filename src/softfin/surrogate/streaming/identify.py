"""The coefficients of the drive's profile, read off logs: CMA-ES on the mean absolute error of the angle.

The mean of the absolute error, so that a stroke that the profile cannot explain does not pull at all the others.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.quantities import TICK_S, AnyArray, Command, Log
from softfin.core.randomness import cma_es, generator_of
from softfin.surrogate.streaming.drive import LONGEST_DELAY, Profile, ProfileState
from softfin.surrogate.streaming.segments import SegmentBatch, Table

SEGMENTS, TICKS = 96, 300
"""How many segments of the logs the coefficients are read off, and how long they are at most [10 ms]."""

POPULATION, GENERATIONS, STARTS = 16, 150, 2


def identify(logs: Sequence[Log], seed: int) -> tuple[Profile, float]:
    """Find the coefficients, and the mean absolute error of the angle [rad] that they leave."""
    ticks = min(TICKS, max(len(log.reading.time) for log in logs) - LONGEST_DELAY - 1)
    segments = Table.of(logs, ticks).draw(jax.random.key(seed), SEGMENTS, ticks)
    errors = jax.jit(jax.vmap(lambda coded: _error(_profile(coded), segments)))
    best, least = None, np.inf
    for start in range(STARTS):
        random = generator_of(seed, f"identify/{start}")
        search = cma_es(
            _guess(logs), 0.2 * (1 + start), random,
            popsize=POPULATION, maxiter=GENERATIONS, tolx=1e-6, tolfun=1e-8,
        )  # fmt: skip
        while not search.stop():
            asked = search.ask()
            search.tell(asked, np.asarray(errors(jnp.asarray(np.stack(asked), jnp.float32)), np.float64).tolist())
        if search.result.fbest < least:
            best, least = search.result.xbest, search.result.fbest
    return _profile(jnp.asarray(best, jnp.float32)), float(least)


def _guess(logs: Sequence[Log]) -> Float[np.ndarray, "coefficients"]:
    """Coefficients of a drive that does what it is told three ticks later, no faster than in the logs."""
    speed = np.abs(np.concatenate([log.reading.velocity for log in logs]))
    change = np.abs(np.concatenate([np.diff(log.reading.velocity) for log in logs])) / TICK_S
    steep = change[change > 0.1 * change.max()]
    return np.array([0.0, 0.0, 3.0, 0.0, 5 * np.log(speed.max()), np.log(np.quantile(steep, 0.8)), 0.0])


def _profile(coded: Float[Array, "coefficients"]) -> Profile:
    """Decode a point of the search: gains, limits and acceleration are logarithms; delay and lag count from 0 on.

    The limit moves in small steps: where it is above all commands it has no effect, and a search gets lost there.
    """
    gain, zero, delay, factor, limit, acceleration, lag = coded
    return Profile(
        jnp.exp(0.1 * gain), 0.05 * zero, jnp.minimum(jnp.abs(delay), LONGEST_DELAY),
        jnp.exp(0.2 * factor), jnp.exp(0.2 * limit), jnp.exp(acceleration), 0.01 * jnp.abs(lag),
    )  # fmt: skip


def _error(profile: Profile, segments: SegmentBatch) -> Float[Array, ""]:
    def one(segment: SegmentBatch) -> Float[Array, ""]:
        def step(state: ProfileState, command: Command) -> tuple[ProfileState, AnyArray]:
            state, _ = profile.step(state, command)
            return state, profile.motion(state).angle

        _, angle = jax.lax.scan(step, profile.start(segment.before, segment.waiting), segment.commands)
        return jnp.mean(jnp.abs(angle - segment.motion.angle))

    return jnp.mean(jax.vmap(one)(segments))
