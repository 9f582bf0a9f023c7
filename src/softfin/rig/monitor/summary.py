"""The traces of a recording in, what a person wants to know at a glance out."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

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
"""Of the mean force, as evaluation judges it [s]."""

SHOWN_EVENTS = 8

MOST = 1e100
"""Of any unit: numbers beyond it come from damage, and their sums are no numbers any more."""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A recording at one moment; None is what is not known, or not yet."""

    path: str
    number: int
    """Of the recording, among all that were followed."""
    state: State
    problem: str | None
    """What went wrong with the reading, in one line that ends in the way out."""
    size_bytes: int
    rows: int
    """Of the joint."""
    rate_hz: float | None
    """Of the joint, over the last 2 s."""
    gaps: int
    """Places of the joint's rows where some are missing at 100 Hz."""
    missing: int
    """Rows that are missing there."""
    force_gaps: int
    """Places of the force's rows."""
    force_missing: int
    damaged: int
    """Chunks and records that could not be read and were passed over."""
    unreadable: int
    """Messages that are not what their type says."""
    age_s: float | None
    """Of the newest row, by this computer's clock."""
    time_s: float | None
    """Of the newest row, since the recording's first."""
    angle_rad: float | None
    velocity_rad_s: float | None
    command_angle_rad: float | None
    command_velocity_rad_s: float | None
    current_a: float | None
    force_n: tuple[float, float] | None
    mean_force_n: tuple[float, float] | None
    """Over the last 2 s."""
    reference_n: tuple[float, float] | None
    events: tuple[tuple[float, str], ...]
    """Time since the recording's first row [s] and text, the newest last."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def readings(traces: Mapping[str, Trace]) -> dict[str, Any]:
    """Those fields of a Summary that the traces tell."""
    joint, wrench = traces["joint"], traces["wrench"]
    angle, velocity = _newest(joint, 2)
    command = _newest(traces["command"], 2)
    events = list(traces["event"].rows)[-SHOWN_EVENTS:]
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
        "command_angle_rad": command[0],
        "command_velocity_rad_s": command[1],
        "current_a": _newest(traces["current"], 1)[0],
        "force_n": _pair(_newest(wrench, 2)),
        "mean_force_n": _mean(wrench),
        "reference_n": _pair(_newest(traces["reference"], 2)),
        "events": tuple((row.time, str(row.values[0])) for row in events),
    }


def finite(value: Any) -> float | None:
    """The number; None where it is none that a device can mean."""
    return value if isinstance(value, float) and abs(value) < MOST else None


def _newest(trace: Trace, count: int) -> list[float | None]:
    return [None] * count if trace.newest is None else [finite(value) for value in trace.newest.values]


def _pair(values: list[float | None]) -> tuple[float, float] | None:
    x, y = values
    return None if x is None or y is None else (x, y)


def _within_window(trace: Trace) -> list[tuple[float, list[float | None]]]:
    """The rows of the last 2 s."""
    if trace.newest is None:
        return []
    since = trace.newest.time - WINDOW_S + TICK_S / 2
    return [(row.time, [finite(value) for value in row.values]) for row in trace.rows if row.time >= since]


def _rate(trace: Trace) -> float | None:
    times = [time for time, _ in _within_window(trace)]
    if len(times) < 2 or times[-1] <= times[0]:
        return None
    return (len(times) - 1) / (times[-1] - times[0])


def _mean(trace: Trace) -> tuple[float, float] | None:
    """None before there are 2 s, and where a force in them is no number."""
    rows = _within_window(trace)
    whole = bool(rows) and trace.rows[0].time <= rows[-1][0] - WINDOW_S + 1.5 * TICK_S
    forces = [force for _, values in rows if (force := _pair(values)) is not None]
    if not whole or len(forces) < len(rows):
        return None
    return sum(x for x, _ in forces) / len(forces), sum(y for _, y in forces) / len(forces)
