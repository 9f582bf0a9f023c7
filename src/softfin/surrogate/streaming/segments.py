"""The training data of streaming networks: logs as one table on the device, random segments of it,
and the scales of its channels."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.quantities import AnyArray, Command, Log
from softfin.surrogate.channels import stack_channels
from softfin.surrogate.training import window_starts

MAX_DELAY = 20
"""Maximum delay from a command to its effect on the motion [ticks]."""


class Motion(NamedTuple):
    """Angle [rad] and angular velocity [rad/s] of the shaft."""

    angle: Float[AnyArray, "*shape"]
    velocity: Float[AnyArray, "*shape"]


class Scales(Configuration):
    """Scales by which the networks' inputs and outputs are divided, computed from the training
    logs."""

    velocity_rad_s: float = Field(gt=0)
    """Standard deviation of the shaft velocity [rad/s]."""
    change_rad_s: float = Field(gt=0)
    """Standard deviation of the tick-to-tick change in velocity [rad/s]."""
    force_n: float = Field(gt=0)
    """Root mean square of the force on both axes [N]."""
    angle_rad: float = Field(gt=0)
    """Standard deviation of the shaft angle [rad]."""


def measure_scales(logs: Sequence[Log]) -> Scales:
    """Compute the scales of the training logs.

    Raises:
        LogError: a channel never changes.
    """
    readings = [log.reading for log in logs]
    joined = jax.tree.map(lambda *x: np.concatenate(x, dtype=np.float64), *readings)
    changes = [np.diff(np.asarray(reading.velocity, np.float64)) for reading in readings]
    values = {
        "angle_rad": joined.angle.std(),
        "velocity_rad_s": joined.velocity.std(),
        "change_rad_s": np.concatenate(changes).std(),
        "force_n": np.sqrt(np.mean(joined.force**2)),
    }
    for name, value in values.items():
        if not value > 0:
            raise LogError(
                f"{name.partition('_')[0]} never changes in the training logs, so no surrogate can "
                "be fitted; use logs in which the fin moves"
            )
    return Scales(**jax.tree.map(float, values))


class SegmentBatch(NamedTuple):
    """Segments of logs."""

    waiting: Command
    """Commands before the first row, newest first, ``(batch, MAX_DELAY)``."""
    commands: Command
    """Commands of all rows except the last, ``(batch, ticks)``."""
    motion: Motion
    """Motion of all rows, ``(batch, 1 + ticks)``."""
    force: Float[Array, "batch ticks 2"]
    """Force of all rows except the first [N]: row k + 1 follows the command of row k."""
    starts: Int[Array, "batch"]
    """Rows of the table at which the segments start."""


class Table(NamedTuple):
    """Concatenated logs, with fields ``(rows,)``."""

    command: Command
    motion: Motion
    force: Float[Array, "rows 2"]
    starts: Int[Array, "choices"]
    """Rows at which a segment can start and lie entirely within one log."""

    @classmethod
    def of(cls, logs: Sequence[Log], ticks: int) -> "Table":
        """Build the table for segments of `ticks` ticks.

        Raises:
            LogError: no log is long enough for a segment.
        """
        # A segment needs MAX_DELAY earlier rows for the commands that have no effect yet at its
        # start.
        rows = [log.rows for log in logs]
        choices = window_starts(rows, ticks, MAX_DELAY)
        if not choices.size:
            raise LogError(
                f"training logs: the longest of {len(logs)} has {max(rows)} rows; at least "
                f"{ticks + MAX_DELAY + 1} are required; record longer logs, or use shorter "
                "segments (--ticks N)"
            )
        columns = stack_channels(logs)
        command = Command(*map(jnp.asarray, columns[:2]))
        motion = Motion(*map(jnp.asarray, columns[2:4]))
        return cls(command, motion, jnp.asarray(columns[4:].T), jnp.asarray(choices))

    @eqx.filter_jit
    def draw(self, key: PRNGKeyArray, batch: int, ticks: int) -> SegmentBatch:
        """Draw random segments, with replacement."""
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
    """Return `length` rows from each start, with fields ``(batch, length, ...)``."""
    rows = starts[:, None] + jnp.arange(length)
    return jax.tree.map(lambda x: x[rows], columns)
