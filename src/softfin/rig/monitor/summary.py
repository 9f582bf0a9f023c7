"""What a person wants to know of a recording at a glance, from its traces; shown by the terminal and by the page."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from softfin.core.action_clock import WINDOW
from softfin.core.quantities import TICK_S
from softfin.rig.monitor.trace import Trace

State = Literal["waiting", "reading", "recording", "silent", "ended", "damaged"]

STATES: dict[State, str] = {
    "waiting": "no rows yet",
    "reading": "reading what was recorded before",
    "recording": "recording",
    "silent": "no new rows: the run was stopped, or its disk cannot be seen from here",
    "ended": "the recording has ended",
    "damaged": "damaged: nothing more can be read",
}

WINDOW_S = WINDOW * TICK_S
"""Window of the mean force, the same as in an evaluation [s]."""

SHOWN_EVENTS = 8

LARGEST = 1e100
"""Numbers beyond it, in any unit, come from damage, and their sums are not finite."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A recording at one moment; None is what is not known, or not yet."""

    path: str
    number: int
    """Number of the recording, among all that were followed."""
    state: State
    problem: str | None
    """What went wrong with the reading, in one line that ends in the way out."""
    size_bytes: int
    rows: int
    """Rows of the joint."""
    rate_hz: float | None
    """Rate of the joint's rows, over the last 2 s."""
    gaps: int
    """Places of the joint's rows where some are missing at 100 Hz."""
    missing: int
    """Rows that are missing there."""
    force_gaps: int
    """Places of the force's rows where some are missing at 100 Hz."""
    force_missing: int
    """Rows that are missing there."""
    damaged: int
    """Chunks and records that could not be read and were passed over."""
    unreadable: int
    """Messages that could not be decoded as their type."""
    age_s: float | None
    """Age of the newest row, by this computer's clock."""
    time_s: float | None
    """Time of the newest row, since the recording's first."""
    angle_rad: float | None
    velocity_rad_s: float | None
    command_angle_rad: float | None
    command_velocity_rad_s: float | None
    current_a: float | None
    force_n: tuple[float, float] | None
    mean_force_n: tuple[float, float] | None
    """Mean force over the last 2 s."""
    reference_n: tuple[float, float] | None
    events: tuple[tuple[float, str], ...]
    """Time since the recording's first row [s] and text, the newest last."""

    def to_dict(self) -> dict[str, Any]:
        """Return all fields, for JSON."""
        return asdict(self)

    def counts(self) -> str:
        """Describe rows, rate, gaps, size and damage in a line."""
        gaps = (("joint", self.gaps, self.missing), ("force", self.force_gaps, self.force_missing))
        found = ", ".join(f"{name} {count:,} ({rows:,} rows)" for name, count, rows in gaps if count)
        parts = [
            f"{self.rows:,} rows",
            "" if self.rate_hz is None else f"{self.rate_hz:.1f} Hz",
            f"gaps: {found}" if found else "no gaps",
            f"{self.size_bytes / 1e6:.1f} MB",
            f"{self.damaged:,} damaged records" if self.damaged else "",
            f"{self.unreadable:,} unreadable messages" if self.unreadable else "",
        ]
        return ", ".join(filter(None, parts))


def readings(traces: Mapping[str, Trace]) -> dict[str, Any]:
    """Return those fields of a Summary that come from the traces."""
    joint, wrench = traces["joint"], traces["wrench"]
    angle, velocity = _newest(joint, 2)
    command_angle, command_velocity = _newest(traces["command"], 2)
    return {
        "rows": joint.count,
        "rate_hz": _rate(joint),
        "gaps": joint.gaps,
        "missing": joint.missing,
        "force_gaps": wrench.gaps,
        "force_missing": wrench.missing,
        "unreadable": sum(trace.unreadable for trace in traces.values()),
        "time_s": max((trace.newest.time for trace in (joint, wrench) if trace.newest), default=None),
        "angle_rad": angle,
        "velocity_rad_s": velocity,
        "command_angle_rad": command_angle,
        "command_velocity_rad_s": command_velocity,
        "current_a": _newest(traces["current"], 1)[0],
        "force_n": _pair(_newest(wrench, 2)),
        "mean_force_n": _mean_force(wrench),
        "reference_n": _pair(_newest(traces["reference"], 2)),
        "events": tuple((row.time, str(row.values[0])) for row in list(traces["event"].rows)[-SHOWN_EVENTS:]),
    }


def finite(value: Any) -> float | None:
    """Return the number; None where it is not one that a device can mean."""
    return value if isinstance(value, float) and abs(value) < LARGEST else None


def _newest(trace: Trace, count: int) -> list[float | None]:
    return [None] * count if trace.newest is None else [finite(value) for value in trace.newest.values]


def _pair(values: list[float | None]) -> tuple[float, float] | None:
    x, y = values
    return None if x is None or y is None else (x, y)


def _last_seconds(trace: Trace) -> np.ndarray:
    """Return time and values of the rows within the window of the mean."""
    rows = trace.array()
    return rows[rows[:, 0] >= rows[-1, 0] - WINDOW_S + TICK_S / 2] if len(rows) else rows


def _rate(trace: Trace) -> float | None:
    times = _last_seconds(trace)[:, 0]
    return None if len(times) < 2 or times[-1] <= times[0] else float((len(times) - 1) / (times[-1] - times[0]))


def _mean_force(trace: Trace) -> tuple[float, float] | None:
    """Return None before there are 2 s, and where a force in them is not a number."""
    rows = _last_seconds(trace)
    is_whole = len(rows) > 0 and trace.rows[0].time <= rows[-1, 0] - WINDOW_S + 1.5 * TICK_S
    if not is_whole or not (np.abs(rows[:, 1:]) < LARGEST).all():
        return None
    x, y = rows[:, 1:].mean(axis=0).tolist()
    return x, y
