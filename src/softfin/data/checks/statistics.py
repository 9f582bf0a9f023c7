"""Statistics of one log: ranges, lags, axes of force, rest; `checks` judges them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.data.checks.alignment import (
    FOLLOWING_TICKS,
    SHORTEST_S,
    Lag,
    Series,
    command_lag,
    force_lag,
    frame_correlations,
    motion,
)  # fmt: skip
from softfin.data.checks.channels import Columns, true_runs
from softfin.data.importing.recording import Part

STILL_RAD_S = 0.05
"""Rate of the angle below which the fin is at rest."""

IDLE_S = 5.0
"""Length of a rest beyond which nothing new is learnt; the random commands are held for at most 1.5 s."""

SETTLED_S = 0.5
"""Time at rest after which the water is still, too."""

POOLED_ROWS = 200_000
"""Rows that are taken together of logs each of which is too short to show a lag."""


@dataclasses.dataclass(frozen=True)
class LogStatistics:
    """Statistics of one log."""

    name: str
    part: Part
    rows: int
    start_s: float
    angle_rad: tuple[float, float]
    """Range of the angle; likewise of the commands."""
    command_angle_rad: tuple[float, float]
    command_velocity_rad_s: tuple[float, float]
    following: float
    """Correlation of the angle with the command of 150 ms before."""
    command_lag: Lag | None
    force_lag: Lag | None
    frames: dict[str, float] | None
    """Correlation with the force of a model fin, for each way to take the force's axes; None for a log under 10 s."""
    resting: float
    """Fraction of the time at rest."""
    idle: float
    """Fraction of the time in rests of more than `IDLE_S`."""
    offset_n: tuple[float, float] | None
    """Mean force on the settled fin; None where it never settles."""
    force_std_n: tuple[float, float]
    command_steps: int
    """Number of rows at which the command changes."""

    def to_dict(self) -> dict[str, Any]:
        """The statistics for JSON."""
        values = dataclasses.asdict(self)
        for name in ("command_lag", "force_lag"):
            lag: Lag | None = values.pop(name)
            values[f"{name}_ms"] = None if lag is None else round(lag.milliseconds, 1)
            values[f"{name}_strength"] = None if lag is None else round(lag.strength, 3)
        return values | {"seconds": self.rows * TICK_S}


def measure(columns: Columns, name: str, part: Part, start_s: float = 0.0) -> LogStatistics:
    """Compute the statistics of a log."""
    force = np.stack([columns.force_x, columns.force_y], axis=1)
    rows, lag = len(force), force_lag(columns.angle, force)
    still = np.abs(motion(columns.angle).velocity) < STILL_RAD_S if rows > 1 else np.ones(rows, bool)
    settled = np.zeros(rows, bool)
    for start, end in true_runs(still):
        settled[start + round(SETTLED_S * RATE_HZ) : end] = True
    long_enough = rows >= SHORTEST_S * RATE_HZ
    return LogStatistics(
        name=name,
        part=part,
        rows=rows,
        start_s=start_s,
        angle_rad=_range(columns.angle),
        command_angle_rad=_range(columns.command_angle),
        command_velocity_rad_s=_range(columns.command_velocity),
        following=_correlation(columns.command_angle[:-FOLLOWING_TICKS], columns.angle[FOLLOWING_TICKS:]),
        command_lag=command_lag(columns.command_angle, columns.command_velocity, columns.angle),
        force_lag=lag,
        frames=frame_correlations(columns.angle, force, lag.milliseconds if lag else 0.0) if long_enough else None,
        resting=float(still.mean()),
        idle=sum(b - a for a, b in true_runs(still) if b - a > IDLE_S * RATE_HZ) / rows,
        offset_n=_pair(force[settled].mean(axis=0)) if settled.sum() >= RATE_HZ else None,
        force_std_n=_pair(force.std(axis=0)),
        command_steps=int((np.diff(columns.command_angle) != 0).sum()),
    )


def measure_together(logs: Sequence[Columns], part: Part) -> LogStatistics:
    """Compute the statistics of short logs end to end: the seams are few beside the steps within."""
    rows = np.cumsum([len(log.angle) for log in logs])
    count = int(np.searchsorted(rows, POOLED_ROWS)) + 1
    joined = Columns(*(np.concatenate(values) for values in zip(*logs[:count], strict=True)))
    together = measure(joined, f"the first {min(count, len(logs))} logs together", part)
    return dataclasses.replace(together, idle=0.0, offset_n=None)


def _range(values: Series) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _pair(values: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _correlation(one: Series, other: Series) -> float:
    if len(one) < RATE_HZ or one.std() == 0 or other.std() == 0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
