"""Channels of one log at 100 Hz in double precision: units told by size, spikes, constant runs."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from softfin.core.quantities import RATE_HZ, TICK_S, Log
from softfin.data.checks.alignment import SHORTEST_S, Series

MOST_RADIANS = {"command_angle": 2 * np.pi, "angle": 2 * np.pi, "command_velocity": 40.0}
"""Sizes beyond which values are degrees: a fin does not turn round, and no drive of one makes 6 turns a second. The
size of a measured velocity proves nothing: the published nets' own jumps reach 145 rad/s."""

SPIKE = 1.2
"""Least height of a spike over half the span of 98% of the samples; the published nets' own jumps reach 0.8."""

SPIKE_Z = 8.0
"""Least robust z of the second difference of a spike: in a series that is rough anyway there are no spikes."""

RESTING_RAD_S = 0.05
"""Least deviation of the angle's rate at which it shows the unit of the velocity."""


class Columns(NamedTuple):
    """All channels of a log but time."""

    command_angle: Series
    command_velocity: Series
    angle: Series
    velocity: Series
    force_x: Series
    force_y: Series


def columns_of(log: Log) -> Columns:
    """Take the channels of a log."""
    command, reading = log
    series = (command.angle, command.velocity, reading.angle, reading.velocity, *np.asarray(reading.force).T)
    return Columns(*(np.asarray(values, np.float64) for values in series))


def channels_in_degrees(columns: Columns, is_velocity_given: bool = False) -> list[str]:
    """Find channels in degrees; the commanded velocity is not in doubt where an option gave it in rad/s."""
    # The size of one sample in a hundred may be a spike's.
    found = [name for name, most in MOST_RADIANS.items() if np.percentile(np.abs(getattr(columns, name)), 99) > most]
    if "angle" in found and 0.5 < velocity_slope(columns)[1] < 2:
        found.append("velocity")
    if {"angle", "command_angle"} <= {*found} and "command_velocity" not in found and not is_velocity_given:
        found.append("command_velocity")
    return found


def velocity_slope(columns: Columns) -> tuple[float, float]:
    """Correlation of the velocity with the angle's rate, and their ratio; 0, 0 where either does not move."""
    rate = np.gradient(columns.angle, TICK_S)
    if rate.std() < RESTING_RAD_S or columns.velocity.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(rate, columns.velocity)[0, 1])
    return correlation, correlation * float(columns.velocity.std() / rate.std())


def without_spikes(columns: Columns) -> Columns:
    """Replace spikes of angle and force; a velocity is mostly a difference of angles, and rough by nature."""
    repaired = {name: find_spikes(getattr(columns, name))[1] for name in ("angle", "force_x", "force_y")}
    return columns._replace(**repaired)


def find_spikes(
    values: Series,
) -> tuple[Int[np.ndarray, "spikes"], Series]:
    """Rows of outliers of one or two samples, and the series with the median of five in their place."""
    if len(values) < SHORTEST_S * RATE_HZ:
        return np.zeros(0, int), values
    padded = np.pad(values, 2, mode="edge")
    middle = np.median(np.stack([padded[k : k + len(values)] for k in range(5)]), axis=0)
    bend = np.abs(np.diff(np.pad(values, 1, mode="edge"), 2))
    # Most of a fin at rest bends by nothing at all: the scale is that of the bends there are.
    scale = 1.4826 * float(np.median(bend[bend > 0])) if (bend > 0).any() else 0.0
    half = 0.5 * float(np.ptp(np.percentile(values, [1, 99])))
    outlying = (np.abs(values - middle) > SPIKE * max(half, 1e-9)) & (bend > SPIKE_Z * scale)
    return np.flatnonzero(outlying), np.where(outlying, middle, values)


def constant_runs(values: Series, least: int) -> list[tuple[int, int]]:
    """First row and the row after the last of each run of one value."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0) + 1, [len(values)]])
    return [(int(a), int(b)) for a, b in itertools.pairwise(edges) if b - a >= least]


def true_runs(flags: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    """First row and the row after the last of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
