"""Logs as one table on the device, and the stretches of it that training draws."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.errors import LogError
from softfin.core.quantities import AnyArray, Command, Log
from softfin.surrogate.streaming.force import Motion, Scales
from softfin.surrogate.streaming.profile import LONGEST_DELAY


class Stretch(NamedTuple):
    """Of logs, ``(batch, ticks)``: commands of rows k, and what rows k + 1 show of them."""

    before: Motion
    """``(batch,)``: of the first row."""
    waiting: Command
    """``(batch, LONGEST_DELAY)``: commands before the first row, newest first."""
    commands: Command
    motion: Motion
    force: Float[Array, "batch ticks 2"]
    """[N]"""
    starts: Int[Array, "batch"]
    """First rows, in the table."""


class Table(NamedTuple):
    """Logs end to end, ``(rows,)``."""

    command: Command
    motion: Motion
    force: Float[Array, "rows 2"]
    starts: Int[Array, "choices"]
    """Rows that a stretch may begin at: all of it lies in one log."""

    @classmethod
    def of(cls, logs: Sequence[Log], ticks: int) -> "Table":
        """For stretches of `ticks`; raises LogError where no log holds one."""
        rows = [len(log.reading.time) for log in logs]
        first = np.cumsum([0, *rows[:-1]])
        starts = [offset + np.arange(LONGEST_DELAY, count - ticks) for offset, count in zip(first, rows, strict=True)]
        choices = np.concatenate(starts).astype(np.int32)
        if not choices.size:
            raise LogError(
                f"the longest of {len(logs)} training logs has {max(rows)} rows; {ticks + LONGEST_DELAY + 1} are "
                "needed in one piece; record longer, or make the stretches shorter (--set ticks=N)"
            )

        def joined(parts: list[AnyArray]) -> Array:
            return jnp.asarray(np.concatenate([np.asarray(part, np.float32) for part in parts]))

        return cls(
            Command(*(joined([log.command[i] for log in logs]) for i in range(2))),
            Motion(joined([log.reading.angle for log in logs]), joined([log.reading.velocity for log in logs])),
            joined([log.reading.force for log in logs]),
            jnp.asarray(choices),
        )

    def draw(self, key: PRNGKeyArray, batch: int, ticks: int) -> Stretch:
        """Stretches at random."""
        starts = self.starts[jax.random.randint(key, (batch,), 0, self.starts.size)]
        cut = slicer(starts, ticks + 1)
        command, motion = (jax.tree.map(cut, part) for part in (self.command, self.motion))
        waiting = jax.tree.map(slicer(starts - LONGEST_DELAY, LONGEST_DELAY), self.command)
        return Stretch(
            before=jax.tree.map(lambda x: x[:, 0], motion),
            waiting=jax.tree.map(lambda x: x[:, ::-1], waiting),
            commands=jax.tree.map(lambda x: x[:, :-1], command),
            motion=jax.tree.map(lambda x: x[:, 1:], motion),
            force=cut(self.force)[:, 1:],
            starts=starts,
        )


def slicer(starts: Int[Array, "batch"], length: int) -> Callable[[Array], Array]:
    """A function that cuts the stretches of `length` rows that begin at `starts` out of a column."""

    def cut(column: Array) -> Array:
        def one(start: Int[Array, ""]) -> Array:
            return jax.lax.dynamic_slice_in_dim(column, start, length)

        return jax.vmap(one)(starts)

    return cut


def scales_of(logs: Sequence[Log]) -> Scales:
    """Of the training logs; raises LogError where nothing moves."""
    angle = np.concatenate([np.asarray(log.reading.angle, np.float64) for log in logs])
    velocity = np.concatenate([np.asarray(log.reading.velocity, np.float64) for log in logs])
    change = np.concatenate([np.diff(np.asarray(log.reading.velocity, np.float64)) for log in logs])
    force = np.concatenate([np.asarray(log.reading.force, np.float64) for log in logs])
    values = {
        "angle_rad": angle.std(),
        "velocity_rad_s": velocity.std(),
        "change_rad_s": change.std(),
        "force_n": np.sqrt(np.mean(force**2)),
    }
    for name, value in values.items():
        if not value > 0:
            raise LogError(f"{name.partition('_')[0]} never changes in the training logs: nothing can be learnt")
    return Scales(**{name: float(value) for name, value in values.items()})
