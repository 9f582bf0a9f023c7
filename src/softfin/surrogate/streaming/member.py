"""One learnt fin: drive net and force net in a row. An ensemble is a stack of these, which predicts whole logs here."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.quantities import Command, Log
from softfin.surrogate.streaming.drive import LONGEST_DELAY, DriveNetConfig, FollowingNet, FollowingState
from softfin.surrogate.streaming.force import ForceNet, ForceNetConfig, ForceState, Motion, Scales

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


def single(members: Tree, index: int = 0) -> Tree:
    """One member of a stack."""
    one: Tree = jax.tree.map(lambda x: x[index], members)
    return one


def parameters(module: eqx.Module) -> int:
    """Numbers that were learnt or read off the logs."""
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(module, eqx.is_array)))


def motions(drive: FollowingNet, motion: Motion, waiting: Command, commands: Command) -> Motion:
    """The shaft's motion under one command a tick, ``(ticks,)``: that of command k is what row k + 1 shows."""

    def step(state: FollowingState, command: Command) -> tuple[FollowingState, Motion]:
        state = drive.step(state, command)
        return state, state.motion

    return jax.lax.scan(step, drive.start(motion, waiting), commands)[1]


def forces(net: ForceNet, before: Motion, motion: Motion) -> Float[Array, "ticks 2"]:
    """The forces of a motion, ``(ticks,)`` [N]; `before` is the motion of the tick before it."""
    return jax.lax.scan(lambda state, now: net.step(state, now), net.start(before), motion)[1]


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

    def of(index: list[int]) -> Motion:
        some = [logs[i] for i in index]
        # What was commanded before a log is not recorded: its first command has long been given.
        commands: Command = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *[log.command for log in some])
        waiting: Command = jax.tree.map(lambda x: np.repeat(x[:, :1], LONGEST_DELAY, axis=1), commands)
        first = [Motion(log.reading.angle[0], log.reading.velocity[0]) for log in some]
        before: Motion = jax.tree.map(lambda *x: np.asarray(x, np.float32), *first)
        predicted = _motions(drives, before, waiting, jax.tree.map(lambda x: x[:, :-1], commands))
        return Motion(*(np.concatenate([np.broadcast_to(x[:, None], (*y.shape[:2], 1)), y], axis=2)
                        for x, y in zip(before, predicted, strict=True)))  # fmt: skip

    return _together([len(log.reading.time) for log in logs], of)


def predict_force(nets: ForceNet, motion: Sequence[Motion]) -> list[Float[np.ndarray, "members rows 2"]]:
    """Predict the forces of motions ``(members, rows)``; a first row has no motion before it and gets the second's."""

    def of(index: list[int]) -> Float[np.ndarray, "members logs rows 2"]:
        force = _forces(nets, jax.tree.map(lambda *x: np.stack(x, axis=1), *[motion[i] for i in index]))
        return np.concatenate([force[:, :, :1], force], axis=2)

    return _together([m.angle.shape[1] for m in motion], of)


def _together(lengths: Sequence[int], of: Callable[[list[int]], Tree]) -> list[Tree]:
    """Logs of equal length side by side; `of` gives fields ``(members, logs, ...)``, each log gets its own."""
    results: dict[int, Tree] = {}
    for length in dict.fromkeys(lengths):
        index = [i for i, other in enumerate(lengths) if other == length]
        together = of(index)
        results |= {i: jax.tree.map(lambda x, n=n: np.asarray(x[:, n]), together) for n, i in enumerate(index)}
    return [results[i] for i in range(len(lengths))]


@eqx.filter_jit
def _motions(drives: FollowingNet, before: Motion, waiting: Command, commands: Command) -> Any:
    return eqx.filter_vmap(lambda drive: jax.vmap(lambda *of: motions(drive, *of))(before, waiting, commands))(drives)


@eqx.filter_jit
def _forces(nets: ForceNet, motion: Motion) -> Any:
    def one(net: ForceNet, motion: Motion) -> Float[Array, "logs ticks 2"]:
        before, after = jax.tree.map(lambda x: x[:, 0], motion), jax.tree.map(lambda x: x[:, 1:], motion)
        return jax.vmap(lambda *of: forces(net, *of))(before, after)

    return eqx.filter_vmap(one)(nets, motion)
