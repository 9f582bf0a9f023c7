"""Logs as one table on the device, the segments that training draws from it, and the scales of its
channels."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.quantities import AnyArray, Command, Log

MAX_DELAY = 20
"""Longest delay from a command to its motion [ticks]."""


class Motion(NamedTuple):
    """Angle [rad] and angular velocity [rad/s] of the shaft."""

    angle: Float[AnyArray, "*shape"]
    velocity: Float[AnyArray, "*shape"]


class Scales(Configuration):
    """Units of the networks' inputs and outputs, from the training logs."""

    velocity_rad_s: float = Field(gt=0)
    """Standard deviation of the shaft's velocity [rad/s]."""
    change_rad_s: float = Field(gt=0)
    """Standard deviation of the velocity's change from tick to tick [rad/s]."""
    force_n: float = Field(gt=0)
    """Root mean square of the force on both axes [N]."""
    angle_rad: float = Field(gt=0)
    """Standard deviation of the shaft's angle [rad]."""


def measure_scales(logs: Sequence[Log]) -> Scales:
    """Compute the scales of the training logs; raises LogError if nothing moves."""
    angle, velocity, force = (
        [np.asarray(getattr(log.reading, name), np.float64) for log in logs]
        for name in ("angle", "velocity", "force")
    )
    values = {
        "angle_rad": np.concatenate(angle).std(),
        "velocity_rad_s": np.concatenate(velocity).std(),
        "change_rad_s": np.concatenate([np.diff(each) for each in velocity]).std(),
        "force_n": np.sqrt(np.mean(np.concatenate(force) ** 2)),
    }
    for name, value in values.items():
        if not value > 0:
            raise LogError(
                f"{name.partition('_')[0]} never changes in the training logs: no surrogate can be "
                "fitted"
            )
    return Scales(**{name: float(value) for name, value in values.items()})


class SegmentBatch(NamedTuple):
    """Segments of logs, ``(batch, ticks)``: the commands of rows k, and the force of rows k + 1."""

    waiting: Command
    """Commands before the first row, newest first, ``(batch, MAX_DELAY)``."""
    commands: Command
    motion: Motion
    """Motion from the first row on, ``(batch, 1 + ticks)``."""
    force: Float[Array, "batch ticks 2"]
    starts: Int[Array, "batch"]
    """First rows, in the table."""


class Table(NamedTuple):
    """Logs end to end, ``(rows,)``."""

    command: Command
    motion: Motion
    force: Float[Array, "rows 2"]
    starts: Int[Array, "choices"]
    """Rows at which a segment may begin, so that all of it is in one log."""

    @classmethod
    def of(cls, logs: Sequence[Log], ticks: int) -> "Table":
        """Build the table for segments of `ticks`; raises LogError if no log is long enough."""
        rows = [len(log.reading.time) for log in logs]
        first = np.cumsum([0, *rows[:-1]])
        starts = [
            offset + np.arange(MAX_DELAY, count - ticks)
            for offset, count in zip(first, rows, strict=True)
        ]
        choices = np.concatenate(starts).astype(np.int32)
        if not choices.size:
            raise LogError(
                f"the longest of {len(logs)} training logs has {max(rows)} rows; "
                f"{ticks + MAX_DELAY + 1} are "
                "needed in one piece; record longer, or make the segments shorter (--set ticks=N)"
            )
        columns = [
            (*log.command, log.reading.angle, log.reading.velocity, log.reading.force)
            for log in logs
        ]
        joined = [
            jnp.asarray(np.concatenate(parts, dtype=np.float32))
            for parts in zip(*columns, strict=True)
        ]
        return cls(Command(*joined[:2]), Motion(*joined[2:4]), joined[4], jnp.asarray(choices))

    def draw(self, key: PRNGKeyArray, batch: int, ticks: int) -> SegmentBatch:
        """Draw segments at random."""
        starts = self.starts[jax.random.randint(key, (batch,), 0, self.starts.size)]
        command, motion, force = slices((self.command, self.motion, self.force), starts, ticks + 1)
        waiting = slices(self.command, starts - MAX_DELAY, MAX_DELAY)
        return SegmentBatch(
            waiting=jax.tree.map(lambda x: x[:, ::-1], waiting),
            commands=jax.tree.map(lambda x: x[:, :-1], command),
            motion=motion,
            force=force[:, 1:],
            starts=starts,
        )


def slices(columns: PyTree, starts: Int[Array, "batch"], length: int) -> Any:
    """Cut the rows ``start .. start + length`` out of columns, for each start: fields ``(batch,
    length, ...)``."""
    rows = starts[:, None] + jnp.arange(length)
    return jax.tree.map(lambda x: x[rows], columns)
