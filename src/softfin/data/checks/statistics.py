"""Channels of one log at 100 Hz in double precision, and its statistics: lags, axes of force, rest;
`checks` judges."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.data.checks.alignment import (
    FOLLOWING_TICKS,
    MIN_ALIGNED_S,
    LogSeries,
    command_lag,
    force_lag,
    frame_correlations,
    measure_rate,
)
from softfin.data.importing.clocks import NamedLog, Part

MAX_RADIANS = {"command_angle": 2 * np.pi, "angle": 2 * np.pi, "command_velocity": 40.0}
"""Magnitudes above which values must be in degrees: a fin does not turn all the way round, and its
drive does not make 6 turns per second. A large measured velocity proves nothing: the jumps of the
published networks reach 145 rad/s."""

MAX_DEGREES = 360.0
"""Magnitude above which an angle is not even in degrees, but in encoder counts."""

REST_RATE_RAD_S = 0.05
"""Rate of the angle below which the fin counts as at rest."""


class LogColumns(NamedTuple):
    """All channels of a log except time."""

    command_angle: LogSeries
    command_velocity: LogSeries
    angle: LogSeries
    velocity: LogSeries
    force_x: LogSeries
    force_y: LogSeries


@dataclasses.dataclass(frozen=True)
class LogStatistics:
    """Statistics of one log."""

    name: str
    part: Part
    rows: int
    start_s: float
    following: float
    """Correlation of the angle with the command 150 ms earlier; 0 for a log under 10 s."""
    command_lag_ms: float | None
    """Lag from command to angle."""
    force_lag_ms: float | None
    """Lag from angle to force."""
    frames: dict[str, float] | None
    """Correlation with the force of a model fin, for each assignment of the force's axes; None for
    a log under 10 s."""
    offset_n: tuple[float, ...] | None
    """Mean force on the settled fin; None if it never settles."""
    force_std_n: tuple[float, ...]


def known_lags(statistics: Sequence[LogStatistics], name: str) -> list[tuple[float, str]]:
    """Return the lags [ms] of one clock, with the names of their logs; logs without one are left
    out."""
    lags = [(getattr(one, f"{name}_lag_ms"), one.name) for one in statistics]
    return [(lag, log) for lag, log in lags if lag is not None]


def to_columns(log: Log) -> LogColumns:
    """Return the channels of a log."""
    return LogColumns(*np.stack(log.channels).astype(np.float64))


def channels_in_counts(columns: LogColumns) -> list[str]:
    """Return the angles that are in encoder counts."""
    names = ("command_angle", "angle")
    return [
        name for name in names if np.percentile(np.abs(getattr(columns, name)), 99) > MAX_DEGREES
    ]


def channels_in_degrees(columns: LogColumns, is_velocity_given: bool) -> list[str]:
    """Return the channels in degrees; the commanded velocity is certain if an option gave it in
    rad/s."""
    # One sample in a hundred may be a spike.
    found = [
        name
        for name, most in MAX_RADIANS.items()
        if np.percentile(np.abs(getattr(columns, name)), 99) > most
    ]
    if "angle" in found and 0.5 < velocity_slope(columns)[1] < 2:
        found.append("velocity")
    if (
        {"angle", "command_angle"} <= {*found}
        and "command_velocity" not in found
        and not is_velocity_given
    ):
        found.append("command_velocity")
    return found


def velocity_slope(columns: LogColumns) -> tuple[float, float]:
    """Correlation of the velocity with the angle's rate, and their ratio; both 0 if either does not
    move."""
    rate = np.gradient(columns.angle, TICK_S)
    if rate.std() < REST_RATE_RAD_S or columns.velocity.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(rate, columns.velocity)[0, 1])
    # The slope of a least-squares line is r std(y) / std(x).
    return correlation, correlation * float(columns.velocity.std() / rate.std())


def without_spikes(values: LogSeries) -> LogSeries:
    """Replace outliers of one or two samples by the median of five.

    A spike exceeds 1.2 times half the span of 98% of the samples (the jumps of the published
    networks reach 0.8 times), and its second difference has a robust z above 8, because a noisy
    series has no spikes.
    """
    if len(values) < MIN_ALIGNED_S * RATE_HZ:
        return values
    middle = np.median(
        np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5), axis=1
    )
    bend = np.abs(np.diff(np.pad(values, 1, mode="edge"), 2))
    # At rest most second differences are exactly 0: the scale is that of the others.
    scale = 1.4826 * float(np.median(bend[bend > 0])) if (bend > 0).any() else 0.0
    half = 0.5 * float(np.ptp(np.percentile(values, [1, 99])))
    return np.where(
        (np.abs(values - middle) > 1.2 * max(half, 1e-9)) & (bend > 8.0 * scale), middle, values
    )


def true_runs(flags: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    """Return the first row of each run of True, and the row after its last."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def measure(columns: LogColumns, named: NamedLog) -> LogStatistics:
    """Compute the statistics of a log from its repaired channels."""
    force = np.stack([columns.force_x, columns.force_y], axis=1)
    rows = len(force)
    lag = force_lag(columns.angle, force)
    following = 0.0
    frames = None
    if rows >= MIN_ALIGNED_S * RATE_HZ:
        frames = frame_correlations(columns.angle, force, lag or 0.0)
        earlier = columns.command_angle[:-FOLLOWING_TICKS]
        later = columns.angle[FOLLOWING_TICKS:]
        if earlier.std() > 0 and later.std() > 0:
            following = float(np.corrcoef(earlier, later)[0, 1])
    settled = np.zeros(rows, bool)
    for start, end in true_runs(np.abs(measure_rate(columns.angle)) < REST_RATE_RAD_S):
        # Half a second later the water is also still.
        settled[start + RATE_HZ // 2 : end] = True
    return LogStatistics(
        name=named.name,
        part=named.part,
        rows=rows,
        start_s=float(named.log.reading.time[0]),
        following=following,
        command_lag_ms=command_lag(columns.command_angle, columns.angle),
        force_lag_ms=lag,
        frames=frames,
        offset_n=tuple(force[settled].mean(axis=0).tolist()) if settled.sum() >= RATE_HZ else None,
        force_std_n=tuple(force.std(axis=0).tolist()),
    )
