"""One learnt fin: drive net and force net in a row. An ensemble is a stack of these."""

import functools
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray

from softfin.core.quantities import Command
from softfin.surrogate.streaming.drive import DriveNet, DriveNetConfig, DriveState, drive_net
from softfin.surrogate.streaming.force import ForceNet, ForceNetConfig, ForceState, Motion, Said, Scales
from softfin.surrogate.streaming.profile import ProfileConfig

Tree = TypeVar("Tree")


class MemberState(NamedTuple):
    """Of both nets."""

    drive: DriveState
    force: ForceState


class Member(eqx.Module):
    """Commands in, motion and force out; one fin, no batch axes."""

    drive: DriveNet
    force: ForceNet

    def start(self, motion: Motion, waiting: Command) -> MemberState:
        """In motion, with the commands of the last `LONGEST_DELAY` ticks, newest first."""
        return MemberState(self.drive.start(motion, waiting), self.force.start(motion))

    def step(self, state: MemberState, command: Command) -> tuple[MemberState, tuple[Motion, Said]]:
        """A tick under a command."""
        drive = self.drive.step(state.drive, command)
        force, said = self.force.step(state.force, drive.motion)
        return MemberState(drive, force), (drive.motion, said)

    def products(self) -> int:
        """Multiplications of the matrix products of one tick."""
        return self.drive.products() + self.force.products()


@functools.partial(jax.jit, static_argnames=("count", "drive", "force", "profile", "scales"))
def ensemble(
    count: int, drive: DriveNetConfig, force: ForceNetConfig, profile: ProfileConfig, scales: Scales, key: PRNGKeyArray
) -> Member:
    """Members with fresh weights of their own: every array has a leading axis ``members``."""

    def one(key: PRNGKeyArray) -> Member:
        keys = jax.random.split(key)
        return Member(drive_net(drive, profile, scales, keys[0]), ForceNet(force, scales, keys[1]))

    stacked: Member = eqx.filter_vmap(one)(jax.random.split(key, count))
    return stacked


def single(members: Tree, index: int = 0) -> Tree:
    """One of a stack."""
    one: Tree = jax.tree.map(lambda x: x[index], members)
    return one


def motions(drive: DriveNet, motion: Motion, waiting: Command, commands: Command) -> Motion:
    """The shaft's motion under one command a tick, ``(ticks,)``: that of command k is what row k + 1 shows."""

    def step(state: DriveState, command: Command) -> tuple[DriveState, Motion]:
        state = drive.step(state, command)
        return state, state.motion

    return jax.lax.scan(step, drive.start(motion, waiting), commands)[1]


def forces(net: ForceNet, before: Motion, motion: Motion) -> Said:
    """The forces of a motion, ``(ticks,)``; `before` is the motion of the tick before it."""

    def step(state: ForceState, now: Motion) -> tuple[ForceState, Said]:
        return net.step(state, now)

    return jax.lax.scan(step, net.start(before), motion)[1]


def parameters(module: eqx.Module) -> int:
    """Numbers that were learnt or read off the logs."""
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(module, eqx.is_array)))
