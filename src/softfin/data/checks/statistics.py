"""Statistics of one log at 100 Hz: lags, force axes and the force at rest.

All channels are in double precision. `checks` decides which statistics are issues.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from softfin.core.quantities import RATE_HZ, Log
from softfin.data.checks.alignment import (
    FOLLOWING_TICKS,
    MIN_ALIGNED_S,
    ForceLag,
    ForceSeries,
    LogSeries,
    Orientation,
    command_lag,
    find_force_lag,
    find_orientation,
    measure_rate,
)
from softfin.data.checks.signals import fin_length, speed_ratio, true_runs, velocity_ratio
from softfin.data.importing.clocks import NamedLog, Part

MAX_RADIANS = {"command_angle": 2 * np.pi, "angle": 2 * np.pi}
"""Magnitudes above which values must be in degrees: a fin never makes a full turn. A large measured
velocity proves nothing: jumps in the published networks' logs reach 145 rad/s."""

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

    @property
    def force(self) -> ForceSeries:
        """Both forces."""
        return self.force_x + 1j * self.force_y


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogStatistics(ForceLag, Orientation):
    """Statistics of one log; for logs under 10 s, force lag, axes and speed are unknown."""

    name: str
    part: Part
    rows: int
    start_s: float
    following: float
    """Correlation between the angle and the command 150 ms earlier; 0 for logs under 10 s."""
    command_lag_ms: float | None
    """Lag from command to angle [ms]."""
    offset_n: tuple[float, ...] | None
    """Mean force while the fin is settled [N]; None if it never settles."""
    force_std_n: tuple[float, ...]
    channels: dict[str, tuple[float, float]]
    """Minimum and maximum of each additional channel."""
    fin_length_m: float
    """Length of a fin that makes forces of this size [m]."""
    speed_ratio: float | None
    """Speed of moves, divided by the commanded velocity."""


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
    if "angle" in found and 0.5 < velocity_ratio(columns.angle, columns.velocity)[1] < 2:
        found.append("velocity")
    # A file with both angles in degrees has the profile velocity in degrees as well, unless the
    # fin moves at about that velocity in rad/s or rpm.
    if len({"angle", "command_angle"} & {*found}) == 2 and not is_velocity_given:
        command = np.radians(columns.command_angle)
        ratio = speed_ratio(command, columns.command_velocity, np.radians(columns.angle))
        if ratio is None or ratio < 0.1:
            found.append("command_velocity")
    return found


def measure(columns: LogColumns, named: NamedLog) -> LogStatistics:
    """Compute the statistics of a log from its repaired channels."""
    force = columns.force
    rows = len(force)
    lag = ForceLag()
    orientation = Orientation()
    speed = None
    following = 0.0
    if rows >= MIN_ALIGNED_S * RATE_HZ:
        lag = find_force_lag(columns.angle, force)
        # A force that lags by n ticks belongs to the motion n ticks earlier.
        lag_ticks = round((lag.force_lag_ms or 0) * RATE_HZ / 1e3)
        orientation = find_orientation(columns.angle, np.roll(force, -lag_ticks))
        speed = speed_ratio(*columns[:3])
        earlier = columns.command_angle[:-FOLLOWING_TICKS]
        later = columns.angle[FOLLOWING_TICKS:]
        if earlier.std() > 0 and later.std() > 0:
            following = float(np.corrcoef(earlier, later)[0, 1])
    settled = np.zeros(rows, bool)
    for start, end in true_runs(np.abs(measure_rate(columns.angle)) < REST_RATE_RAD_S):
        # The water around a fin of half a metre takes another 0.8 s to become still.
        settled[start + 4 * RATE_HZ // 5 : end] = True
    offset = None
    if settled.sum() >= RATE_HZ:
        mean = force[settled].mean()
        offset = (float(mean.real), float(mean.imag))
    return LogStatistics(
        name=named.name,
        part=named.part,
        rows=rows,
        start_s=float(named.log.reading.time[0]),
        following=following,
        command_lag_ms=command_lag(columns.command_angle, columns.angle),
        offset_n=offset,
        force_std_n=(float(columns.force_x.std()), float(columns.force_y.std())),
        channels={
            channel: (float(np.min(values)), float(np.max(values)))
            for channel, values in named.log.channels.items()
        },
        fin_length_m=fin_length(columns.angle, force),
        speed_ratio=speed,
        **vars(lag),
        **vars(orientation),
    )
