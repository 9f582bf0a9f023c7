"""One learnt fin: drive net and force net in a row. An ensemble is a stack of these, which predicts whole logs here."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.quantities import Command, Log
from softfin.surrogate.streaming.nets import (
    DriveNetConfig,
    FollowingNet,
    FollowingState,
    ForceNet,
    ForceNetConfig,
    ForceState,
)
from softfin.surrogate.streaming.segments import LONGEST_DELAY, Motion, Scales

Tree = TypeVar("Tree")


class MemberState(NamedTuple):
    """States of both nets."""

    drive: FollowingState
    force: ForceState


class Member(eqx.Module):
    """Commands in, motion and force out; one fin, no batch axes."""

    drive: FollowingNet
    force: ForceNet

    def start(self, motion: Motion, waiting: Command) -> MemberState:
        """State in motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return MemberState(self.drive.start(motion, waiting), self.force.start(motion))

    def step(self, state: MemberState, command: Command) -> tuple[MemberState, tuple[Motion, Float[Array, "2"]]]:
        """Step by a tick under a command."""
        drive = self.drive.step(state.drive, command)
        force, predicted = self.force.step(state.force, drive.motion)
        return MemberState(drive, force), (drive.motion, predicted)


@functools.partial(jax.jit, static_argnames=("count", "drive", "force", "scales"))
def ensemble(count: int, drive: DriveNetConfig, force: ForceNetConfig, scales: Scales, key: PRNGKeyArray) -> Member:
    """Make members with fresh weights of their own: every array has a leading axis ``members``."""

    def one(key: PRNGKeyArray) -> Member:
        keys = jax.random.split(key)
        return Member(FollowingNet(drive, scales, keys[0]), ForceNet(force, scales, keys[1]))

    stacked: Member = eqx.filter_vmap(one)(jax.random.split(key, count))
    return stacked


def single(members: Tree, index: Any = 0) -> Tree:
    """One member of a stack."""
    one: Tree = jax.tree.map(lambda x: x[index], members)
    return one


def parameters(module: eqx.Module) -> int:
    """Numbers that were learnt or read off the logs."""
    return sum(leaf.size for leaf in jax.tree.leaves(module))


def motions(drive: FollowingNet, before: Motion, waiting: Command, commands: Command) -> Motion:
    """The shaft's motion under one command a tick, ``(ticks,)``: that of command k is what row k + 1 shows."""

    def step(state: FollowingState, command: Command) -> tuple[FollowingState, Motion]:
        state = drive.step(state, command)
        return state, state.motion

    return jax.lax.scan(step, drive.start(before, waiting), commands)[1]


def forces(net: ForceNet, motion: Motion) -> Float[Array, "ticks 2"]:
    """The forces of all rows of a motion ``(1 + ticks,)`` but the first [N]."""
    before, after = (jax.tree.map(lambda x, part=part: x[part], motion) for part in (0, slice(1, None)))
    return jax.lax.scan(lambda state, now: net.step(state, now), net.start(before), after)[1]


class LogPrediction(NamedTuple):
    """Prediction of a log's rows, free-running from its first, which itself is the measured one; NumPy."""

    motion: Motion
    """Motion predicted by each member, ``(members, rows)``."""
    force: Float[np.ndarray, "members rows 2"]
    """Force predicted by each member [N]; that of the first row is the second's."""


def predict_logs(members: Member, logs: Sequence[Log]) -> list[LogPrediction]:
    """Predict every log from its commands and its first row alone."""
    motion = predict_motion(members.drive, logs)
    return [LogPrediction(*pair) for pair in zip(motion, predict_force(members.force, motion), strict=True)]


def predict_motion(drives: FollowingNet, logs: Sequence[Log]) -> list[Motion]:
    """Predict the motion of every log, ``(members, rows)``."""

    def predict(some: Sequence[Log]) -> Motion:
        # What was commanded before a log is not recorded: its first command has long been given.
        command, reading = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *some)
        waiting = Command(*(np.repeat(x[:, :1], LONGEST_DELAY, axis=1) for x in command))
        before = Motion(reading.angle[:, 0], reading.velocity[:, 0])
        predicted = _motions(drives, before, waiting, Command(*(x[:, :-1] for x in command)))
        return Motion(*(np.concatenate([np.broadcast_to(x[:, None], (*y.shape[:2], 1)), y], axis=2)
                        for x, y in zip(before, predicted, strict=True)))  # fmt: skip

    return _together(logs, [len(log.reading.time) for log in logs], predict)


def predict_force(nets: ForceNet, motion: Sequence[Motion]) -> list[Float[np.ndarray, "members rows 2"]]:
    """Predict the forces of motions ``(members, rows)``; a first row has no motion before it and gets the second's."""

    def predict(some: Sequence[Motion]) -> Float[np.ndarray, "members logs rows 2"]:
        force = _forces(nets, jax.tree.map(lambda *x: np.stack(x, axis=1), *some))
        return np.concatenate([force[:, :, :1], force], axis=2)

    return _together(motion, [each.angle.shape[1] for each in motion], predict)


def _together(records: Sequence[Any], rows: Sequence[int], predict: Callable[[Any], Any]) -> list[Any]:
    """What `predict` makes of records of equal length, side by side on the second axis; of each record its own."""
    results: dict[int, Any] = {}
    for length in set(rows):
        index = [i for i, other in enumerate(rows) if other == length]
        predicted = predict([records[i] for i in index])
        results |= {i: jax.tree.map(lambda x, n=n: np.asarray(x[:, n]), predicted) for n, i in enumerate(index)}
    return [results[i] for i in range(len(rows))]


@eqx.filter_jit
def _motions(drives: FollowingNet, *given: Any) -> Any:
    return eqx.filter_vmap(lambda drive: jax.vmap(functools.partial(motions, drive))(*given))(drives)


@eqx.filter_jit
def _forces(nets: ForceNet, motion: Motion) -> Any:
    return eqx.filter_vmap(lambda net, motion: jax.vmap(functools.partial(forces, net))(motion))(nets, motion)
