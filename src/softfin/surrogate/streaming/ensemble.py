"""Members of an ensemble (a drive and a force network in series), their predictions of logs, and
their error estimates.

The interval on the mean force is split conformal (Lei et al. 2018, J. Am. Stat. Assoc. 113:1094):
the errors on held-out logs are divided by the size expected from the members' disagreement, and
their quantile scales the interval. The errors of one log and axis share its drift, so K logs
contain little more than 2 K independent ones: the quantile is widened by the ratio of Student's t
with 2 K degrees of freedom to the normal quantile. The same logs were used to choose among ten sets
of weights for each member, so the interval is calibrated but not guaranteed. The distance of a
motion from the training data is the Mahalanobis distance in the memory of a network (Lee et al.
2018, NeurIPS), which depends on the last motion.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from pydantic import Field
from scipy.special import ndtri, stdtrit

from softfin.core.configuration import Configuration
from softfin.core.quantities import AnyArray, Command, Log
from softfin.core.window import window_means
from softfin.data.issues import counted
from softfin.surrogate.streaming.nets import (
    DriveNetConfig,
    FollowingNet,
    FollowingState,
    ForceNet,
    ForceNetConfig,
    ForceState,
)
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, Scales

COVERAGE = 0.9
"""Fraction of the mean forces that an interval should contain."""

ENOUGH_LOGS = 10
"""Number of held-out logs below which differences between logs, such as the drift, are poorly
known."""

RARE = 0.999
"""Fraction of the training data with a distance below 1."""

LOGS = 50
EVERY = 7
"""Number of logs that define the distance, and ticks between the moments taken from them."""


class MemberState(NamedTuple):
    """States of both networks."""

    drive: FollowingState
    force: ForceState


class Member(eqx.Module):
    """Maps commands to motion and force; one fin, no batch axes."""

    drive: FollowingNet
    force: ForceNet

    def start(self, motion: Motion, waiting: Command) -> MemberState:
        """Return the state for a given motion and the commands of the last `MAX_DELAY` ticks,
        newest first."""
        return MemberState(self.drive.start(motion, waiting), self.force.start(motion))

    def step(
        self, state: MemberState, command: Command
    ) -> tuple[MemberState, tuple[Motion, Float[Array, "2"]]]:
        """Advance by one tick under a command."""
        drive = self.drive.step(state.drive, command)
        force, predicted = self.force.step(state.force, drive.motion)
        return MemberState(drive, force), (drive.motion, predicted)


def ensemble(
    count: int, drive: DriveNetConfig, force: ForceNetConfig, scales: Scales, key: PRNGKeyArray
) -> Member:
    """Create members with different new weights: every array has a leading axis ``members``."""

    def one(key: PRNGKeyArray) -> Member:
        keys = jax.random.split(key)
        return Member(FollowingNet(drive, scales, keys[0]), ForceNet(force, scales, keys[1]))

    stacked: Member = eqx.filter_vmap(one)(jax.random.split(key, count))
    return stacked


def single(members: PyTree, index: int | Array = 0) -> Any:
    """Return one member of a stack."""
    return jax.tree.map(lambda x: x[index], members)


def parameters(module: eqx.Module) -> int:
    """Return the number of parameters that were trained or identified from the logs."""
    return sum(leaf.size for leaf in jax.tree.leaves(module))


def motions(drive: FollowingNet, before: Motion, waiting: Command, commands: Command) -> Motion:
    """Return the shaft's motion under one command per tick, ``(1 + ticks,)``: row k + 1 follows
    command k."""

    def step(state: FollowingState, command: Command) -> tuple[FollowingState, Motion]:
        state = drive.step(state, command)
        return state, state.motion

    after = jax.lax.scan(step, drive.start(before, waiting), commands)[1]
    motion: Motion = jax.tree.map(jnp.append, before, after)
    return motion


def forces(net: ForceNet, motion: Motion) -> Float[Array, "ticks 2"]:
    """Return the forces of all rows of a motion ``(1 + ticks,)`` except the first [N]."""
    before, after = _split_first_row(motion)
    return jax.lax.scan(lambda state, now: net.step(state, now), net.start(before), after)[1]


def _split_first_row(motion: Motion) -> tuple[Motion, Motion]:
    return single(motion), jax.tree.map(lambda x: x[1:], motion)


def predict_motion(drives: FollowingNet, logs: Sequence[Log]) -> list[Motion]:
    """Predict the motion of every log, ``(members, rows)``, from only its commands and its first
    row; NumPy."""

    def predict(some: Sequence[Log]) -> Any:
        # The commands before a log are not recorded: its first command is assumed to have been held
        # for long.
        command, reading = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *some)
        waiting = jax.tree.map(lambda x: np.repeat(x[:, :1], MAX_DELAY, axis=1), command)
        before = Motion(reading.angle[:, 0], reading.velocity[:, 0])
        return _motions(drives, before, waiting, jax.tree.map(lambda x: x[:, :-1], command))

    return _together(logs, [log.rows for log in logs], predict)


def predict_force(
    nets: ForceNet, motion: Sequence[Motion]
) -> list[Float[np.ndarray, "members rows 2"]]:
    """Predict the forces of motions ``(members, rows)``; the first row has no motion before it and
    gets the force of the second."""

    def predict(some: Sequence[Motion]) -> Float[np.ndarray, "members logs rows 2"]:
        force = _forces(nets, jax.tree.map(lambda *x: np.stack(x, axis=1), *some))
        return np.concatenate([force[:, :, :1], force], axis=2)

    return _together(motion, [each.angle.shape[1] for each in motion], predict)


def _together(
    records: Sequence[PyTree], rows: Sequence[int], predict: Callable[[PyTree], PyTree]
) -> list[Any]:
    """Predict for records of equal length, stacked on the second axis."""
    results: list[Any] = [None] * len(rows)
    for length in set(rows):
        index = np.flatnonzero(np.equal(rows, length)).tolist()
        predicted = predict([records[i] for i in index])
        for place, i in enumerate(index):
            results[i] = jax.tree.map(lambda x, n=place: np.asarray(x[:, n]), predicted)
    return results


@eqx.filter_jit
def _motions(drives: FollowingNet, *given: Any) -> Any:
    return eqx.filter_vmap(lambda drive: jax.vmap(functools.partial(motions, drive))(*given))(
        drives
    )


@eqx.filter_jit
def _forces(nets: ForceNet, motion: Motion) -> Any:
    return eqx.filter_vmap(lambda net, motion: jax.vmap(functools.partial(forces, net))(motion))(
        nets, motion
    )


class Interval(Configuration):
    """Interval for the mean force over the evaluation window, on each axis.

    half width = factor * sqrt(spread^2 + floor^2), with the variance spread^2 over the members.
    """

    coverage: float = Field(gt=0, lt=1)
    """Fraction of the means that it should contain [-]."""
    factor: float = Field(gt=0)
    """Quantile of |error| / sqrt(spread^2 + floor^2) on the held-out logs, widened because they are
    few [-]."""
    floor_n: float = Field(gt=0)
    """Root mean square error of the ensemble's mean there [N]: noise, drift, and the common error
    of all members."""
    windows: int = Field(ge=1)
    """Number of means used for the calibration, over both axes, from `logs` logs."""
    logs: int = Field(ge=1)

    def half_width(self, means: Float[AnyArray, "members *shape"]) -> Float[AnyArray, "*shape"]:
        """Return the half width of the interval, from the means of the members [N]."""
        return self.factor * (means.var(axis=0) + self.floor_n**2) ** 0.5

    def caveat(self) -> str | None:
        """Reason not to rely on the interval, in one sentence, or None."""
        if self.logs >= ENOUGH_LOGS:
            return None
        return (
            f"intervals come from {counted(self.logs, 'held-out log')}; they are widened for that, "
            f"but from less than {ENOUGH_LOGS} it is luck how much they hold of what differs from "
            "log to log, such as the sensor's drift"
        )


def calibrated(
    predicted: Sequence[Float[np.ndarray, "members rows 2"]], logs: Sequence[Log], burn_in: int
) -> Interval:
    """Calibrate the interval on the members' predictions of held-out logs after the first `burn_in`
    ticks."""
    means = np.concatenate([window_means(force[:, burn_in:]) for force in predicted], axis=1)
    measured = np.concatenate(
        [window_means(np.asarray(log.reading.force)[burn_in:]) for log in logs]
    )
    # The score of split conformal prediction: ratio = |error| / sqrt(spread^2 + floor^2).
    error = np.abs(means.mean(axis=0) - measured)
    floor_n = float(np.sqrt(np.mean(error**2)))
    ratio = error / (means.var(axis=0) + floor_n**2) ** 0.5
    # One more than there are, so that the next error is covered and not only the known ones: the
    # quantile at COVERAGE (n + 1) / n.
    level = min(1.0, COVERAGE * (1 + 1 / ratio.size))
    factor = float(np.quantile(ratio, level, method="inverted_cdf"))
    # Errors of one log and axis are correlated, because they share its drift: widened by the ratio
    # of the two-sided quantiles, t(2 K) / z.
    upper = (1 + COVERAGE) / 2
    widened = factor * float(stdtrit(2 * len(logs), upper) / ndtri(upper))
    return Interval(
        coverage=COVERAGE, factor=widened, floor_n=floor_n, windows=ratio.size, logs=len(logs)
    )


class Familiarity(eqx.Module):
    """The training data as seen in the memory of the first member's force network."""

    mean: Float[Array, "remembered"]
    whitening: Float[Array, "remembered remembered"]
    """Inverse square root of the covariance, divided by the distance that only 1 of 1000 training
    moments exceeds."""

    def distance(self, memory: Float[Array, "remembered"]) -> Float[Array, ""]:
        """Return the out-of-distribution score: 1 if only one in a thousand moments of the training
        data is as far out."""
        return jnp.sqrt(jnp.sum(((memory - self.mean) @ self.whitening) ** 2))


def remembered(state: ForceState) -> Float[Array, "remembered"]:
    """Return the memory of a force network, in which the distance is measured."""
    return jnp.concatenate(jax.tree.leaves((state.memory, state.wake)))


def familiar(nets: ForceNet, motion: Sequence[Motion], burn_in: int) -> Familiarity:
    """Compute the distribution of training logs, from their predicted motion ``(members, rows)``
    after row `burn_in`."""
    some = [single(each) for each in motion if each.angle.shape[1] > burn_in + 1][:LOGS]
    memory = np.concatenate(
        [_memories(single(nets), each)[burn_in::EVERY] for each in some]
    ).astype(np.float64)
    # With the covariance V diag(s) V^T, the Mahalanobis distance is |(m - mean) V / sqrt(s)|.
    mean = memory.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(memory, rowvar=False))
    # In a direction without any variation, rounding errors would look like a large distance.
    whitening = vectors / np.sqrt(np.maximum(values, 1e-6 * values.max()))
    far = np.quantile(np.linalg.norm((memory - mean) @ whitening, axis=1), RARE)
    return Familiarity(jnp.asarray(mean, jnp.float32), jnp.asarray(whitening / far, jnp.float32))


@eqx.filter_jit
def _memories(net: ForceNet, motion: Motion) -> Float[Array, "ticks remembered"]:
    """Return the memory after every row of a motion ``(rows,)`` except the first."""

    def step(state: ForceState, now: Motion) -> tuple[ForceState, Array]:
        state, _ = net.step(state, now)
        return state, remembered(state)

    before, after = _split_first_row(motion)
    return jax.lax.scan(step, net.start(before), after)[1]
