"""Whole logs under an ensemble: the commands in, what each member says of every row out."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from softfin.core.quantities import Command, Log
from softfin.surrogate.streaming.drive import DriveNet
from softfin.surrogate.streaming.force import ForceNet, Motion, Said
from softfin.surrogate.streaming.member import Member, forces, motions
from softfin.surrogate.streaming.profile import LONGEST_DELAY

Tree = TypeVar("Tree")


class Followed(NamedTuple):
    """A log's rows, free-running from its first, which itself is the measured one; NumPy."""

    angle: Float[np.ndarray, "members rows"]
    velocity: Float[np.ndarray, "members rows"]
    force: Float[np.ndarray, "members rows 2"]


def follow(members: Member, logs: Sequence[Log]) -> list[Followed]:
    """Every log, from its commands and its first row alone."""
    motion = follow_motion(members.drive, logs)
    each = zip(motion, follow_force(members.force, motion), strict=True)
    return [Followed(*map(np.asarray, (*shaft, said.force))) for shaft, said in each]


def follow_motion(drives: DriveNet, logs: Sequence[Log]) -> list[Motion]:
    """The motion of every log, ``(members, rows)``."""

    def of(index: list[int]) -> Motion:
        some = [logs[i] for i in index]
        # What was commanded before a log is not known: its first command has long been given.
        commands: Command = jax.tree.map(lambda *x: np.stack(x).astype(np.float32), *[log.command for log in some])
        waiting: Command = jax.tree.map(lambda x: np.repeat(x[:, :1], LONGEST_DELAY, axis=1), commands)
        first = [Motion(log.reading.angle[0], log.reading.velocity[0]) for log in some]
        before: Motion = jax.tree.map(lambda *x: np.asarray(x, np.float32), *first)
        said = _motions(drives, before, waiting, jax.tree.map(lambda x: x[:, :-1], commands))
        members = len(said.angle)
        motion: Motion = jax.tree.map(
            lambda x, said: np.concatenate([np.tile(x[None, :, None], (members, 1, 1)), said], axis=2), before, said
        )
        return motion

    return _together([len(log.reading.time) for log in logs], of)


def follow_force(nets: ForceNet, motion: Sequence[Motion]) -> list[Said]:
    """The forces of motions ``(members, rows)``; of a first row nothing is known, so the second's stands there."""

    def of(index: list[int]) -> Said:
        said = _forces(nets, jax.tree.map(lambda *x: np.stack(x, axis=1), *[motion[i] for i in index]))
        whole: Said = jax.tree.map(lambda x: np.concatenate([x[:, :, :1], x], axis=2), said)
        return whole

    return _together([m.angle.shape[1] for m in motion], of)


def _together(lengths: Sequence[int], of: Callable[[list[int]], Tree]) -> list[Tree]:
    """Logs of equal length side by side; `of` gives fields ``(members, logs, ...)``, each log gets its own."""
    results: dict[int, Tree] = {}
    for length in dict.fromkeys(lengths):
        index = [i for i, other in enumerate(lengths) if other == length]
        said = of(index)
        results |= {i: jax.tree.map(lambda x, n=n: np.asarray(x[:, n]), said) for n, i in enumerate(index)}
    return [results[i] for i in range(len(lengths))]


@eqx.filter_jit
def _motions(drives: DriveNet, before: Motion, waiting: Command, commands: Command) -> Any:
    return eqx.filter_vmap(lambda drive: jax.vmap(lambda *of: motions(drive, *of))(before, waiting, commands))(drives)


@eqx.filter_jit
def _forces(nets: ForceNet, motion: Motion) -> Any:
    def one(net: ForceNet, motion: Motion) -> Said:
        before, after = jax.tree.map(lambda x: x[:, 0], motion), jax.tree.map(lambda x: x[:, 1:], motion)
        said: Said = jax.vmap(lambda *of: forces(net, *of))(before, after)
        return said

    return eqx.filter_vmap(one)(nets, motion)
