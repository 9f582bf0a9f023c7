"""The members of an ensemble, their predictions for logs, and their error estimates. Each member is
a drive network followed by a force network.

The interval for the mean force is computed by split conformal prediction (Lei et al. 2018, J. Am.
Stat. Assoc. 113:1094): errors on held-out logs are divided by the error expected from the spread of
the members, and a quantile of these ratios scales the interval. All errors on one log and axis
share the same drift, so K logs contain only slightly more than 2 K independent errors. The quantile
is therefore multiplied by the ratio of the Student's t quantile with 2 K degrees of freedom to the
normal quantile. The coverage is not guaranteed, because the same logs were used to choose the
weights of each member from up to ten candidates.

The distance of a motion from the training data is the Mahalanobis distance (Lee et al. 2018,
NeurIPS) of the memory of a force network, which depends on the recent motion.
"""

import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from pydantic import Field
from scipy.special import ndtri, stdtrit

from softfin.core.compilation import jit
from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AnyArray, Command, Log
from softfin.core.window import window_means
from softfin.data.issues import counted
from softfin.surrogate.protocol import COVERAGE
from softfin.surrogate.streaming.nets import (
    DriveNetConfig,
    FollowingNet,
    FollowingState,
    ForceNet,
    ForceNetConfig,
    ForceState,
)
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion, Scales

ENOUGH_LOGS = 10
"""Minimum number of held-out logs for a reliable interval; fewer may not represent differences
between logs, such as drift."""

RARE = 0.999
"""Fraction of the training data with a distance below 1."""

MEMORY_LOGS = 50
"""Maximum number of training logs used to define the distance."""

EVERY = 7
"""Interval between the samples used from these logs [ticks]."""


class MemberState(NamedTuple):
    """States of the two networks of a member."""

    drive: FollowingState
    force: ForceState


class Member(eqx.Module):
    """Maps commands to motion and force, for one fin without batch axes."""

    drive: FollowingNet
    force: ForceNet

    def start(self, motion: Motion, waiting: Command) -> MemberState:
        """Return the state for a motion and the commands of the last `MAX_DELAY` ticks, newest
        first."""
        return MemberState(self.drive.start(motion, waiting), self.force.start(motion))

    def step(
        self, state: MemberState, command: Command
    ) -> tuple[MemberState, tuple[Motion, Float[Array, "2"]]]:
        """Advance by one tick under a command; return the new motion and force [N]."""
        drive = self.drive.step(state.drive, command)
        force, predicted = self.force.step(state.force, drive.motion)
        return MemberState(drive, force), (drive.motion, predicted)


def ensemble(
    count: int, drive: DriveNetConfig, force: ForceNetConfig, scales: Scales, key: PRNGKeyArray
) -> Member:
    """Initialize members with different weights; every array has a leading axis ``members``."""

    def one(key: PRNGKeyArray) -> Member:
        keys = jax.random.split(key)
        return Member(FollowingNet(drive, scales, keys[0]), ForceNet(force, scales, keys[1]))

    stacked: Member = eqx.filter_vmap(one)(jax.random.split(key, count))
    return stacked


def single(members: PyTree, index: int | Array = 0) -> Any:
    """Return one member of a stack."""
    return jax.tree.map(lambda x: x[index], members)


def parameters(module: eqx.Module) -> int:
    """Return the number of parameters that are trained on or identified from logs."""
    return sum(leaf.size for leaf in jax.tree.leaves(module))


def motions(drive: FollowingNet, before: Motion, waiting: Command, commands: Command) -> Motion:
    """Predict the motion of the shaft under one command per tick.

    Returns:
        Motion with fields ``(1 + ticks,)``: row 0 is `before`, and row k + 1 follows command k.
    """

    def step(state: FollowingState, command: Command) -> tuple[FollowingState, Motion]:
        state = drive.step(state, command)
        return state, state.motion

    after = jax.lax.scan(step, drive.start(before, waiting), commands)[1]
    motion: Motion = jax.tree.map(jnp.append, before, after)
    return motion


def forces(net: ForceNet, motion: Motion) -> Float[Array, "ticks 2"]:
    """Predict the forces for all rows of a motion ``(1 + ticks,)`` except the first [N]."""
    before, after = split_first_row(motion)
    return jax.lax.scan(lambda state, now: net.step(state, now), net.start(before), after)[1]


def split_first_row(motion: Motion) -> tuple[Motion, Motion]:
    """Return the first row of a motion, and all other rows."""
    return single(motion), jax.tree.map(lambda x: x[1:], motion)


def predict_motion(drives: FollowingNet, logs: Sequence[Log]) -> list[Motion]:
    """Predict the motion of each log from its commands and its first row.

    Returns:
        Motions with fields ``(members, rows)``, as NumPy arrays.
    """

    def predict(some: Sequence[Log]) -> Motion:
        # Commands before the start of a log were not recorded. Assume that the first command has
        # been held for longer than MAX_DELAY.
        command, reading = jax.tree.map(
            lambda *x: np.stack(x).astype(np.float32),
            *((log.command, log.reading) for log in some),
        )
        waiting = jax.tree.map(lambda x: np.repeat(x[:, :1], MAX_DELAY, axis=1), command)
        before = Motion(reading.angle[:, 0], reading.velocity[:, 0])
        return _motions(drives, before, waiting, jax.tree.map(lambda x: x[:, :-1], command))

    return _together(logs, [log.rows for log in logs], predict)


def predict_force(
    nets: ForceNet, motion: Sequence[Motion]
) -> list[Float[np.ndarray, "members rows 2"]]:
    """Predict the forces for motions ``(members, rows)``.

    A force depends on the change since the previous row, so the first row gets the force of the
    second row.
    """

    def predict(some: Sequence[Motion]) -> Float[np.ndarray, "members logs rows 2"]:
        force = np.asarray(_forces(nets, jax.tree.map(lambda *x: np.stack(x, axis=1), *some)))
        return np.concatenate([force[:, :, :1], force], axis=2)

    return _together(motion, [each.angle.shape[1] for each in motion], predict)


def _together(
    records: Sequence[PyTree], rows: Sequence[int], predict: Callable[[PyTree], PyTree]
) -> list[Any]:
    """Predict all records of equal length together, stacked on the second axis."""
    results: list[PyTree] = [None] * len(rows)
    # The prediction is compiled once per length.
    for length in set(rows):
        index = np.flatnonzero(np.equal(rows, length)).tolist()
        predicted = jax.tree.map(np.asarray, predict([records[i] for i in index]))
        for place, i in enumerate(index):
            results[i] = jax.tree.map(lambda x, n=place: x[:, n], predicted)
    return results


@jit("low")
def _motions(drives: FollowingNet, before: Motion, waiting: Command, commands: Command) -> Motion:
    def predict(drive: FollowingNet) -> Motion:
        motion: Motion = jax.vmap(functools.partial(motions, drive))(before, waiting, commands)
        return motion

    predicted: Motion = eqx.filter_vmap(predict)(drives)
    return predicted


@eqx.filter_jit
def _forces(nets: ForceNet, motion: Motion) -> Any:
    return eqx.filter_vmap(lambda net, motion: jax.vmap(functools.partial(forces, net))(motion))(
        nets, motion
    )


class MeanInterval(Configuration):
    """Interval for a mean over the evaluation window.

    half width = factor * sqrt(spread^2 + floor^2), where spread^2 is the variance over the members
    and floor the root mean square error of the ensemble mean on the held-out logs. The floor
    includes noise, drift and the error common to all members.
    """

    coverage: float = Field(gt=0, lt=1)
    """Target fraction of means inside the interval [-]."""
    factor: float = Field(gt=0)
    """Quantile of |error| / sqrt(spread^2 + floor^2) on the held-out logs, increased because there
    are few logs [-]."""

    @property
    @abstractmethod
    def noise_floor(self) -> float:
        """Floor in the unit of the mean."""

    def half_width(self, means: Float[AnyArray, "members *shape"]) -> Float[AnyArray, "*shape"]:
        """Return the half-width of the interval for the mean of each member."""
        return self.factor * (means.var(axis=0) + self.noise_floor**2) ** 0.5


# The order of the fields is part of the identity of a surrogate.
class Interval(MeanInterval):
    """Interval for the mean force, on each axis."""

    floor_n: float = Field(gt=0)
    """Floor [N]."""
    windows: int = Field(ge=1)
    """Number of mean forces used for the calibration, counting both axes."""
    logs: int = Field(ge=1)
    """Number of held-out logs from which these mean forces are taken."""

    @property
    def noise_floor(self) -> float:
        """Floor [N]."""
        return self.floor_n

    def caveat(self) -> str | None:
        """Return the reason why the interval may be unreliable, or None."""
        if self.logs >= ENOUGH_LOGS:
            return None
        return (
            f"intervals are calibrated on {counted(self.logs, 'held-out log')} and widened because "
            f"there are so few; with fewer than {ENOUGH_LOGS} logs they may miss differences "
            "between logs, such as sensor drift"
        )


class PowerInterval(MeanInterval):
    """Interval for the mean power delivered to the fin."""

    floor_w: float = Field(gt=0)
    """Floor [W]."""
    windows: int = Field(ge=1)
    """Number of mean powers used for the calibration."""
    logs: int = Field(ge=1)
    """Number of held-out logs from which these mean powers are taken."""

    @property
    def noise_floor(self) -> float:
        """Floor [W]."""
        return self.floor_w


def calibrated(
    predicted: Sequence[Float[np.ndarray, "members rows 2"]], logs: Sequence[Log], burn_in: int
) -> Interval:
    """Calibrate the interval on predictions of held-out logs, without their first `burn_in`
    ticks."""
    means = np.concatenate([window_means(force[:, burn_in:]) for force in predicted], axis=1)
    measured = np.concatenate(
        [window_means(np.asarray(log.reading.force)[burn_in:]) for log in logs]
    )
    floor_n, entries = calibrate(means, measured, len(logs))
    return Interval(floor_n=floor_n, **entries)


def calibrate(
    means: Float[np.ndarray, "members windows axes"],
    measured: Float[np.ndarray, "windows axes"],
    logs: int,
) -> tuple[float, JsonObject]:
    """Return the noise floor and the other fields of a `MeanInterval` for the predicted and
    measured means of a number of logs."""
    # The score of split conformal prediction: ratio = |error| / sqrt(spread^2 + floor^2). The floor
    # keeps the ratio finite where the members agree by chance.
    error = np.abs(means.mean(axis=0) - measured)
    noise_floor = float(np.sqrt(np.mean(error**2)))
    ratio = error / (means.var(axis=0) + noise_floor**2) ** 0.5
    # A new error and the n known errors are exchangeable, so the quantile of the new error is the
    # quantile of the known errors at COVERAGE (n + 1) / n.
    level = min(1.0, COVERAGE * (1 + 1 / ratio.size))
    factor = float(np.quantile(ratio, level, method="inverted_cdf"))
    # Errors on one log and axis are correlated because they share the same drift. The factor is
    # multiplied by the ratio of the two-sided quantiles, t(2 K) / z for two axes.
    upper = (1 + COVERAGE) / 2
    widened = factor * float(stdtrit(ratio.shape[1] * logs, upper) / ndtri(upper))
    return noise_floor, {
        "coverage": COVERAGE,
        "factor": widened,
        "windows": ratio.size,
        "logs": logs,
    }


class Familiarity(eqx.Module):
    """Distribution of the force-network memory of the first member over the training data."""

    mean: Float[Array, "remembered"]
    """Mean of the memory [-]."""
    whitening: Float[Array, "remembered remembered"]
    """Inverse square root of the covariance, divided by the distance that 1 in 1000 training
    samples exceeds."""

    def distance(self, memory: Float[Array, "remembered"]) -> Float[Array, ""]:
        """Return the out-of-distribution score; 1 in 1000 training samples has a score above 1."""
        return jnp.sqrt(jnp.sum(((memory - self.mean) @ self.whitening) ** 2))


def remembered(state: ForceState) -> Float[Array, "remembered"]:
    """Return the memory of a force network as one vector for `Familiarity.distance`."""
    return jnp.concatenate(jax.tree.leaves((state.memory, state.wake)))


def familiar(nets: ForceNet, motion: Sequence[Motion], burn_in: int) -> Familiarity:
    """Compute the distribution of the memory over training logs.

    Args:
        nets: Force networks of all members; the first one is used.
        motion: Predicted motion of each log, with fields ``(members, rows)``.
        burn_in: Number of rows to skip at the start of each log.
    """
    long_enough = [single(each) for each in motion if each.angle.shape[1] > burn_in + 1]
    # Consecutive samples are almost equal, so only some of them are used.
    memories = [
        np.asarray(_memories(single(nets), each))[burn_in::EVERY]
        for each in long_enough[:MEMORY_LOGS]
    ]
    memory = np.concatenate(memories).astype(np.float64)
    # With the covariance V diag(s) V^T, the Mahalanobis distance is |(m - mean) V / sqrt(s)|.
    mean = memory.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(memory, rowvar=False))
    # Without the lower bound, rounding errors in a direction without variation would cause a large
    # distance.
    whitening = vectors / np.sqrt(np.maximum(values, 1e-6 * values.max()))
    far = np.quantile(np.linalg.norm((memory - mean) @ whitening, axis=1), RARE)
    return Familiarity(jnp.asarray(mean, jnp.float32), jnp.asarray(whitening / far, jnp.float32))


@jit("none")
def _memories(net: ForceNet, motion: Motion) -> Float[Array, "ticks remembered"]:
    """Return the memory after each row of a motion ``(rows,)`` except the first."""

    def step(state: ForceState, now: Motion) -> tuple[ForceState, Array]:
        state, _ = net.step(state, now)
        return state, remembered(state)

    before, after = split_first_row(motion)
    return jax.lax.scan(step, net.start(before), after)[1]
