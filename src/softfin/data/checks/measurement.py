"""What a log says of itself, in numbers: ranges, lags, axes of force, rest; `judgement` says what is wrong."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.data.checks.faults import Columns
from softfin.data.importing.alignment import FOLLOWING_TICKS, SHORTEST_S, Lag, command_lag, force_lag, motion
from softfin.data.importing.frame import frame_correlations
from softfin.data.importing.recording import NamedLog, Part

STILL_RAD_S = 0.05
"""The fin is at rest below this."""

IDLE_S = 5.0
"""A rest that is longer teaches nothing new; the random commands are held for at most 1.5 s."""

SETTLED_S = 0.5
"""After so long at rest the water, too, leaves the fin alone."""

POOLED_ROWS = 200_000
"""Of logs that are each too short to tell a lag, so many are taken together."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What was measured of one log."""

    name: str
    part: Part
    rows: int
    start_s: float
    angle_rad: tuple[float, float]
    command_angle_rad: tuple[float, float]
    command_velocity_rad_s: tuple[float, float]
    following: float
    """Correlation of the angle with the command of 150 ms before."""
    command_lag: Lag | None
    force_lag: Lag | None
    frames: dict[str, float] | None
    """Correlation with what a fin does, for each way to take the force's axes; None for a log under 10 s."""
    resting: float
    """Share of the time."""
    idle: float
    """Share of the time in rests of more than `IDLE_S`."""
    offset_n: tuple[float, float] | None
    """Mean force of a fin that has settled; None where it never has."""
    force_std_n: tuple[float, float]
    command_steps: int
    """Rows at which the command changes."""

    def described(self) -> dict[str, Any]:
        """For JSON."""
        values = dataclasses.asdict(self)
        for name in ("command_lag", "force_lag"):
            lag: Lag | None = values.pop(name)
            values[f"{name}_ms"] = None if lag is None else round(lag.milliseconds, 1)
            values[f"{name}_strength"] = None if lag is None else round(lag.strength, 3)
        return values | {"seconds": self.rows * TICK_S}


def measured(log: NamedLog, columns: Columns) -> Facts:
    """What a log says of itself."""
    force = np.stack([columns.force_x, columns.force_y], axis=1)
    of_force = force_lag(columns.angle, force)
    still = np.abs(motion(columns.angle).velocity) < STILL_RAD_S if len(force) > 1 else np.ones(len(force), bool)
    settled = _settled(still)
    return Facts(
        name=log.name,
        part=log.part,
        rows=len(force),
        start_s=float(log.log.reading.time[0]),
        angle_rad=_range(columns.angle),
        command_angle_rad=_range(columns.command_angle),
        command_velocity_rad_s=_range(columns.command_velocity),
        following=_correlation(columns.command_angle[:-FOLLOWING_TICKS], columns.angle[FOLLOWING_TICKS:]),
        command_lag=command_lag(columns.command_angle, columns.command_velocity, columns.angle),
        force_lag=of_force,
        frames=None if len(force) < SHORTEST_S * RATE_HZ else frame_correlations(
            columns.angle, force, 0.0 if of_force is None else of_force.milliseconds),
        resting=float(still.mean()),
        idle=sum(b - a for a, b in _true_runs(still) if b - a > IDLE_S * RATE_HZ) / len(force),
        offset_n=_pair(force[settled].mean(axis=0)) if settled.sum() >= RATE_HZ else None,
        force_std_n=_pair(force.std(axis=0)),
        command_steps=int((np.diff(columns.command_angle) != 0).sum()),
    )  # fmt: skip


def pooled(facts: Sequence[Facts], logs: Sequence[Columns]) -> Facts:
    """Of short logs together: the seams between them are few beside the steps within."""
    rows, taken = 0, []
    for log in logs:
        taken.append(log)
        rows += len(log.angle)
        if rows >= POOLED_ROWS:
            break
    joined = Columns(*(np.concatenate(values) for values in zip(*taken, strict=True)))
    force = np.stack([joined.force_x, joined.force_y], axis=1)
    lag = force_lag(joined.angle, force)
    frames = (
        None
        if rows < SHORTEST_S * RATE_HZ
        else frame_correlations(joined.angle, force, lag.milliseconds if lag else 0.0)
    )
    return dataclasses.replace(
        facts[0], name=f"the first {len(taken)} logs together", rows=rows, frames=frames, force_lag=lag,
        command_lag=command_lag(joined.command_angle, joined.command_velocity, joined.angle), idle=0.0, offset_n=None,
        following=_correlation(joined.command_angle[:-FOLLOWING_TICKS], joined.angle[FOLLOWING_TICKS:]),
    )  # fmt: skip


def _settled(still: Bool[np.ndarray, "ticks"]) -> Bool[np.ndarray, "ticks"]:
    settled = np.zeros(len(still), bool)
    for start, end in _true_runs(still):
        settled[start + round(SETTLED_S * RATE_HZ) : end] = True
    return settled


def _true_runs(flags: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _range(values: Float[np.ndarray, "ticks"]) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _pair(values: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _correlation(one: Float[np.ndarray, "ticks"], other: Float[np.ndarray, "ticks"]) -> float:
    if len(one) < RATE_HZ or one.std() == 0 or other.std() == 0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
