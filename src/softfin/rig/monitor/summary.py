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
    damaged: int
    """Chunks and records that could not be read and were passed over."""
    age_s: float | None
    """Age of the newest row, by this computer's clock."""
    time_s: float | None
    """Time of the newest row, since the recording's first."""
    rows: int
    """Rows of the joint."""
    rate_hz: float | None
    """Rate of the joint's rows, over the last 2 s."""
    gaps: int
    """Places of the joint's rows where some are missing at 100 Hz, and how many are."""
    missing: int
    force_gaps: int
    """Gaps in the rows of the force."""
    force_missing: int
    unreadable: int
    """Messages that could not be decoded as their type."""
    angle_rad: float | None
    velocity_rad_s: float | None
    command_angle_rad: float | None
    command_velocity_rad_s: float | None
    current_a: float | None
    force_n: tuple[float, float] | None
    mean_force_n: tuple[float, float] | None
    """Mean force over the last 2 s; None where a force in them is not a number."""
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


def summarize(traces: Mapping[str, Trace], **about_the_file: Any) -> Summary:
    """Summarize a recording from its traces and from what is known of its file."""
    joint, wrench = traces["joint"], traces["wrench"]
    angle, velocity = _newest(joint)
    command_angle, command_velocity = _newest(traces["command"])
    recent, forces = (rows[rows[:, 0] >= rows[:, 0].max(initial=0.0) - WINDOW_S + TICK_S / 2]
                      for rows in (joint.array(), wrench.array()))  # fmt: skip
    span = recent[-1, 0] - recent[0, 0] if len(recent) else 0.0
    is_whole = len(forces) > 0 and wrench.rows[0].time <= forces[-1, 0] - WINDOW_S + 1.5 * TICK_S
    mean = forces[:, 1:].mean(axis=0).tolist() if is_whole and (np.abs(forces[:, 1:]) < LARGEST).all() else [None] * 2
    return Summary(
        rows=joint.count,
        rate_hz=float((len(recent) - 1) / span) if span > 0 else None,
        gaps=joint.gaps,
        missing=joint.missing,
        force_gaps=wrench.gaps,
        force_missing=wrench.missing,
        unreadable=sum(trace.unreadable for trace in traces.values()),
        angle_rad=angle,
        velocity_rad_s=velocity,
        command_angle_rad=command_angle,
        command_velocity_rad_s=command_velocity,
        current_a=_newest(traces["current"])[0],
        force_n=_pair(_newest(wrench)),
        mean_force_n=_pair(mean),
        reference_n=_pair(_newest(traces["reference"])),
        events=tuple((row.time, str(row.values[0])) for row in list(traces["event"].rows)[-SHOWN_EVENTS:]),
        **about_the_file,
    )


def finite(value: Any) -> float | None:
    """Return the number; None where it is not one that a device can mean."""
    return value if isinstance(value, float) and abs(value) < LARGEST else None


def _newest(trace: Trace) -> list[float | None]:
    newest = trace.newest
    return [None, None] if newest is None else [finite(value) for value in newest.values]


def _pair(values: list[float | None]) -> tuple[float, float] | None:
    x, y = values
    return None if x is None or y is None else (x, y)
