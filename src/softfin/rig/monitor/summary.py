"""Summary of a recording: the last seconds of each topic, and what a person wants to know at a
glance."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64

from softfin.core.action_clock import WINDOW
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.core.quantities import TICK_S
from softfin.storage.bag import messages
from softfin.storage.bag.messages import JOINT_STATE, TYPES, WRENCH_STAMPED, type_store
from softfin.storage.bag.zero import RestForce, parse_zero, zeros_at

MAX_ROWS = 30_000
"""Rows of one topic that are held, whatever their times say: 30 s of a sensor that streams at 1
kHz."""

MAX_CHARACTERS = 300
"""Characters of an event's text that are shown."""

WINDOW_S = WINDOW * TICK_S
"""Window of the mean force, the same as in an evaluation [s]."""

MAX_NUMBER = 1e100
"""Numbers beyond it, in any unit, come from damage, and their sums are not finite."""

ROLES = {
    "joint": messages.JOINT,
    "wrench": messages.WRENCH,
    "command": messages.COMMAND,
    "reference": messages.REFERENCE,
    "current": messages.CURRENT,
    "event": messages.EVENTS,
}
"""The topic of each role."""

STATES = {
    "waiting": "no rows yet",
    "reading": "reading earlier rows",
    "recording": "recording",
    "silent": "no new rows: the run has stopped, or its disk is not reachable",
    "ended": "recording complete",
    "damaged": "damaged: the rest cannot be read",
}

Summary: TypeAlias = JsonObject
"""A recording at one moment, ready for JSON; None is what is not known, or not yet."""

Values: TypeAlias = tuple[float | str, ...]
"""Angle [rad] and velocity [rad/s] of a joint or command; force x and y [N]; a current [A]; a
text."""


def decode_message(role: str, type_name: str, data: bytes) -> Values | None:
    """Return the values of a message; None where it is of another type than softfin records, or
    damaged."""
    if type_name != TYPES[ROLES[role]]:
        return None
    try:
        message: Any = type_store().deserialize_cdr(data, type_name)
        if type_name == JOINT_STATE:
            velocity = float(message.velocity[0]) if len(message.velocity) else float("nan")
            return float(message.position[0]), velocity
        if type_name == WRENCH_STAMPED:
            return float(message.wrench.force.x), float(message.wrench.force.y)
        return (
            printable(message.data, most=MAX_CHARACTERS)
            if role == "event"
            else float(message.data),
        )
    except Exception:
        # Generated code reads damaged bytes, and fails in ways of its own; the caller counts it.
        return None


class TraceRow(NamedTuple):
    """One message."""

    serial: int
    """Number of the row among all that the follower has taken in."""
    time: float
    """Time of logging, since the recording's first message [s]."""
    values: Values


class Trace:
    """Rows of one topic in the order in which they were written; messages are decoded when they are
    needed."""

    def __init__(self, role: str) -> None:
        self.role = role
        self.rows: deque[TraceRow] = deque(maxlen=MAX_ROWS)
        self.count = self.unreadable = 0
        self.gaps = 0
        """Places where rows at 100 Hz are missing."""
        self.missing = 0
        """Rows that would fill them."""
        self.last: float | None = None
        """Time of the message that came last, decoded or not [s]."""
        self.zeros: Sequence[tuple[float, RestForce]] = ()
        """Zeros of the force, each with the time at which it was measured [s]; `less_zero`
        subtracts them."""
        self._waiting: deque[tuple[float, str, bytes]] = deque(maxlen=MAX_ROWS)

    def offer(self, time: float, type_name: str, data: bytes) -> None:
        """Count a message, and hold it until `settle`."""
        self.count += 1
        if self.last is not None and time - self.last > 1.5 * TICK_S:
            self.gaps += 1
            self.missing += round((time - self.last) / TICK_S) - 1
        self.last = time
        self._waiting.append((time, type_name, data))

    def settle(self, since: float, serials: Iterator[int]) -> None:
        """Decode what was offered, from the last row before `since` on: it holds until the next one
        comes."""
        while self._waiting:
            time, type_name, data = self._waiting.popleft()
            if self._waiting and self._waiting[0][0] < since:
                continue
            values = decode_message(self.role, type_name, data)
            if values is None:
                self.unreadable += 1
            else:
                self.rows.append(TraceRow(next(serials), time, values))
        while len(self.rows) > 1 and self.rows[1].time < since:
            self.rows.popleft()

    def recorded_zeros(self) -> list[tuple[float, RestForce]]:
        """Return the zeros of the force that events record, each with the time at which it was
        measured [s]."""
        parsed = ((row.time, parse_zero(str(row.values[0]))) for row in self.rows)
        return [(time, zero) for time, zero in parsed if zero is not None]

    def less_zero(self, row: TraceRow) -> TraceRow:
        """Return a row less the zero of its time: rows stay raw, because a zero may be read after
        them."""
        if not self.zeros:
            return row
        zero = zeros_at(self.zeros, np.array([row.time]))[0].tolist()
        return row._replace(
            values=tuple(value - offset for value, offset in zip(row.values, zero, strict=True))
        )

    def newest(self) -> list[float | None]:
        """Return the two numbers that came last; None for what is not there."""
        values = self.less_zero(self.rows[-1]).values if self.rows else ()
        return [finite(value) for value in values] + [None] * 2

    def array(self) -> Float64[np.ndarray, "rows columns"]:
        """Return time [s] and numbers of the rows that are held."""
        rows = np.array(
            [(row.time, *row.values) for row in self.rows] or np.zeros((0, 3)), np.float64
        )
        if self.zeros:
            rows[:, 1:] -= zeros_at(self.zeros, rows[:, 0])
        return rows


def summarize(traces: Mapping[str, Trace], **about_the_file: object) -> Summary:
    """Summarize a recording from its traces and from what is known of its file."""
    joint = traces["joint"]
    wrench = traces["wrench"]
    angle, velocity, *_ = joint.newest()
    command_angle, command_velocity, *_ = traces["command"].newest()
    recent, forces = (
        rows[rows[:, 0] >= rows[:, 0].max(initial=0.0) - WINDOW_S + TICK_S / 2]
        for rows in (joint.array(), wrench.array())
    )
    span = recent[-1, 0] - recent[0, 0] if len(recent) else 0.0
    is_whole = len(forces) > 0 and wrench.rows[0].time <= forces[-1, 0] - WINDOW_S + 1.5 * TICK_S
    has_mean = is_whole and bool((np.abs(forces[:, 1:]) < MAX_NUMBER).all())
    return {
        **about_the_file,
        # Of the joint; the rate is that of the last 2 s, gaps are places where rows are missing at
        # 100 Hz.
        "rows": joint.count,
        "rate_hz": float((len(recent) - 1) / span) if span > 0 else None,
        "gaps": joint.gaps,
        "missing": joint.missing,
        "force_gaps": wrench.gaps,
        "force_missing": wrench.missing,
        # Messages that could not be decoded as their type.
        "unreadable": sum(trace.unreadable for trace in traces.values()),
        "angle_rad": angle,
        "velocity_rad_s": velocity,
        "command_angle_rad": command_angle,
        "command_velocity_rad_s": command_velocity,
        "current_a": traces["current"].newest()[0],
        "force_n": _pair(wrench.newest()),
        # Over the last 2 s; None where a force in them is not a number.
        "mean_force_n": _pair(forces[:, 1:].mean(axis=0).tolist()) if has_mean else None,
        "reference_n": _pair(traces["reference"].newest()),
        # Time since the recording's first row [s] and text, the newest last.
        "events": [(row.time, str(row.values[0])) for row in list(traces["event"].rows)[-8:]],
    }


def counts(summary: Summary) -> str:
    """Describe rows, rate, gaps, size and damage in a line."""
    gaps = (
        ("joint", summary["gaps"], summary["missing"]),
        ("force", summary["force_gaps"], summary["force_missing"]),
    )
    found = ", ".join(f"{name} {count:,} ({rows:,} rows)" for name, count, rows in gaps if count)
    parts = [
        f"{summary['rows']:,} rows",
        "" if summary["rate_hz"] is None else f"{summary['rate_hz']:.1f} Hz",
        f"gaps: {found}" if found else "no gaps",
        f"{summary['size_bytes'] / 1e6:.1f} MB",
        f"{summary['damaged']:,} damaged records" if summary["damaged"] else "",
        f"{summary['unreadable']:,} unreadable messages" if summary["unreadable"] else "",
    ]
    return ", ".join(filter(None, parts))


def finite(value: object) -> float | None:
    """Return the number; None where it is not one that a device can mean."""
    return value if isinstance(value, float) and abs(value) < MAX_NUMBER else None


def _pair(values: list[float | None]) -> tuple[float, float] | None:
    x, y, *_ = values
    return None if x is None or y is None else (x, y)
