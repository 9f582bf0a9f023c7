"""Statistics of one log at 100 Hz: lags, force axes and the force at rest.

All channels are in double precision. `checks` decides which statistics are issues.
"""

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
"""Magnitudes above which values must be in degrees: a fin never makes a full turn, and its drive
never reaches 6 turns per second. A large measured velocity proves nothing: jumps in the published
networks' logs reach 145 rad/s."""

MAX_DEGREES = 360.0
"""Magnitude above which an angle must be in encoder counts, not in degrees."""

REST_RATE_RAD_S = 0.05
"""Rate of the angle below which the fin is treated as at rest [rad/s]."""


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
    """Correlation between the angle and the command 150 ms earlier; 0 for logs under 10 s."""
    command_lag_ms: float | None
    """Lag from command to angle [ms]."""
    force_lag_ms: float | None
    """Lag from angle to force [ms]."""
    frames: dict[str, float] | None
    """Correlation with the force of a model fin, by assignment of the force axes; None for logs
    under 10 s."""
    offset_n: tuple[float, ...] | None
    """Mean force while the fin is settled [N]; None if it never settles."""
    force_std_n: tuple[float, ...]
    channels: dict[str, tuple[float, float]]
    """Minimum and maximum of each further channel."""


def known_lags(statistics: Sequence[LogStatistics], name: str) -> list[tuple[float, str]]:
    """Return the known command or force lags [ms], each with the name of its log."""
    lags = []
    for one in statistics:
        lag = getattr(one, f"{name}_lag_ms")
        if lag is not None:
            lags.append((lag, one.name))
    return lags


def to_columns(log: Log) -> LogColumns:
    """Return the columns of a log in float64."""
    return LogColumns(*np.stack(log.columns).astype(np.float64))


def channels_in_counts(columns: LogColumns) -> list[str]:
    """Return the angles that are in encoder counts."""
    names = ("command_angle", "angle")
    return [name for name in names if _magnitude(getattr(columns, name)) > MAX_DEGREES]


def _magnitude(values: LogSeries) -> float:
    # Not the maximum: one sample in a hundred may be a spike.
    return float(np.percentile(np.abs(values), 99))


def channels_in_degrees(columns: LogColumns, is_velocity_given: bool) -> list[str]:
    """Return the channels that are in degrees. Set `is_velocity_given` if an option sets the
    commanded velocity, which is then in rad/s."""
    found = []
    for name, limit in MAX_RADIANS.items():
        if _magnitude(getattr(columns, name)) > limit:
            found.append(name)
    # A velocity in degrees is only recognizable by its ratio to an angle in degrees.
    if "angle" in found and 0.5 < velocity_slope(columns)[1] < 2:
        found.append("velocity")
    # A slow profile velocity in deg/s looks like one in rad/s, but a file with both angles in
    # degrees has it in degrees as well.
    if (
        {"angle", "command_angle"} <= {*found}
        and "command_velocity" not in found
        and not is_velocity_given
    ):
        found.append("command_velocity")
    return found


def velocity_slope(columns: LogColumns) -> tuple[float, float]:
    """Return the correlation between velocity and angular rate, and their ratio; both are 0 if
    either is constant."""
    rate = np.gradient(columns.angle, TICK_S)
    if rate.std() < REST_RATE_RAD_S or columns.velocity.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(rate, columns.velocity)[0, 1])
    # Slope of a least-squares line: r std(y) / std(x).
    return correlation, correlation * float(columns.velocity.std() / rate.std())


def without_spikes(values: LogSeries) -> LogSeries:
    """Replace outliers of one or two samples with the median of five samples.

    A spike deviates from that median by more than 1.2 times half the range of 98% of the samples;
    jumps in the published networks' logs reach 0.8 times. Its second difference must also have a
    robust z-score above 8, so that noise is not treated as spikes.
    """
    if len(values) < MIN_ALIGNED_S * RATE_HZ:
        return values
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5)
    middle = np.median(windows, axis=1)
    bend = np.abs(np.diff(np.pad(values, 1, mode="edge"), 2))
    # At rest most second differences are exactly 0, so only the others set the scale. 1.4826 times
    # the median of absolute values is the standard deviation of normal noise.
    scale = 1.4826 * float(np.median(bend[bend > 0])) if (bend > 0).any() else 0.0
    half_range = 0.5 * float(np.ptp(np.percentile(values, [1, 99])))
    is_far = np.abs(values - middle) > 1.2 * max(half_range, 1e-9)
    is_spike = is_far & (bend > 8.0 * scale)
    return np.where(is_spike, middle, values)


def true_runs(flags: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    """Return (first row, one past the last row) of each run of True."""
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
        # The water takes another half second to become still.
        settled[start + RATE_HZ // 2 : end] = True
    offset = None
    if settled.sum() >= RATE_HZ:
        offset = tuple(force[settled].mean(axis=0).tolist())
    return LogStatistics(
        name=named.name,
        part=named.part,
        rows=rows,
        start_s=float(named.log.reading.time[0]),
        following=following,
        command_lag_ms=command_lag(columns.command_angle, columns.angle),
        force_lag_ms=lag,
        frames=frames,
        offset_n=offset,
        force_std_n=tuple(force.std(axis=0).tolist()),
        channels={
            channel: (float(np.min(values)), float(np.max(values)))
            for channel, values in named.log.channels.items()
        },
    )
