"""Summary of a recording: the last seconds of each topic, and its state at a glance."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.core.quantities import TICK_S
from softfin.storage.bag import messages
from softfin.storage.bag.messages import JOINT_STATE, TYPES, WRENCH_STAMPED, type_store
from softfin.storage.bag.zero import RestForce, parse_zero, zeros_at

MAX_ROWS = 30_000
"""Maximum number of rows kept per topic, regardless of their times: 30 s of a sensor that streams
at 1 kHz."""

MAX_CHARACTERS = 300
"""Maximum number of characters of an event's text that are shown."""

WINDOW_S = PAPER_CLOCK.window_ticks * TICK_S
"""Averaging window of the mean force [s], for every action clock: a recording does not contain its
clock."""

MAX_NUMBER = 1e100
"""Largest plausible number in any unit; larger ones come from damaged data and may have infinite
sums."""

ROLES = {
    "joint": messages.JOINT,
    "wrench": messages.WRENCH,
    "command": messages.COMMAND,
    "reference": messages.REFERENCE,
    "current": messages.CURRENT,
    "event": messages.EVENTS,
}
"""Topic for each role."""

STATES = {
    "waiting": "no rows yet",
    "reading": "reading earlier rows",
    "recording": "recording",
    "silent": "no new rows: the run has stopped, or its disk is not reachable",
    "ended": "recording complete",
    "damaged": "damaged: the rest cannot be read",
}

Summary: TypeAlias = JsonObject
"""State of a recording at one time, for JSON; unknown values are None."""

Values: TypeAlias = tuple[float | str, ...]
"""Angle [rad] and velocity [rad/s] of a joint or command; reference force (x, y) [N]; force (x, y)
[N] and torque about the shaft [N m] of a wrench; current [A]; or text."""


def decode_message(role: str, type_name: str, data: bytes) -> Values | None:
    """Return the values of a message; None if its type is not the one that softfin records, or if
    it is damaged."""
    if type_name != TYPES[ROLES[role]]:
        return None
    try:
        message: Any = type_store().deserialize_cdr(data, type_name)
        if type_name == JOINT_STATE:
            velocity = float(message.velocity[0]) if len(message.velocity) else float("nan")
            return float(message.position[0]), velocity
        if type_name == WRENCH_STAMPED:
            force = float(message.wrench.force.x), float(message.wrench.force.y)
            return (*force, float(message.wrench.torque.z)) if role == "wrench" else force
        return (
            printable(message.data, most=MAX_CHARACTERS)
            if role == "event"
            else float(message.data),
        )
    except Exception:
        # The generated decoder may raise any exception for damaged bytes; the caller counts them.
        return None


class TraceRow(NamedTuple):
    """One message."""

    serial: int
    """Serial number among all rows read by the follower."""
    time: float
    """Log time since the recording's first message [s]."""
    values: Values


class Trace:
    """Rows of one topic, in the order in which they were written; messages are decoded only when
    needed."""

    def __init__(self, role: str) -> None:
        self.role = role
        self.rows: deque[TraceRow] = deque(maxlen=MAX_ROWS)
        self.count = self.unreadable = 0
        self.gaps = 0
        """Number of gaps in the 100 Hz rows."""
        self.missing = 0
        """Number of rows missing in the gaps."""
        self.last: float | None = None
        """Time of the latest message, decoded or not [s]."""
        self.zeros: Sequence[tuple[float, RestForce]] = ()
        """Zeros of the force with the times at which they were measured [s]; subtracted by
        `less_zero`."""
        self._waiting: deque[tuple[float, str, bytes]] = deque(maxlen=MAX_ROWS)

    def offer(self, time: float, type_name: str, data: bytes) -> None:
        """Count a message and keep it until `settle`."""
        self.count += 1
        if self.last is not None and time - self.last > 1.5 * TICK_S:
            self.gaps += 1
            self.missing += round((time - self.last) / TICK_S) - 1
        self.last = time
        self._waiting.append((time, type_name, data))

    def settle(self, since: float, serials: Iterator[int]) -> None:
        """Decode the offered messages, starting with the last one before `since` [s], which is
        valid until the next one; discard older rows."""
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
        """Return the zeros of the force recorded in events, with the times at which they were
        measured [s]."""
        parsed = ((row.time, parse_zero(str(row.values[0]))) for row in self.rows)
        return [(time, zero) for time, zero in parsed if zero is not None]

    def less_zero(self, row: TraceRow) -> TraceRow:
        """Return a row minus the zero valid at its time; stored rows remain raw, because a zero may
        be read after them."""
        if not self.zeros:
            return row
        # The torque has no zero.
        zero = (*zeros_at(self.zeros, np.array([row.time]))[0].tolist(), 0.0)
        return row._replace(
            values=tuple(value - offset for value, offset in zip(row.values, zero, strict=True))
        )

    def newest(self) -> list[float | None]:
        """Return the latest values, padded with None."""
        values = self.less_zero(self.rows[-1]).values if self.rows else ()
        return [finite(value) for value in values] + [None] * 3

    def array(self) -> Float64[np.ndarray, "rows columns"]:
        """Return the time [s] and values of the stored rows."""
        rows = np.array(
            [(row.time, *row.values) for row in self.rows] or np.zeros((0, 4)), np.float64
        )
        if self.zeros:
            rows[:, 1:3] -= zeros_at(self.zeros, rows[:, 0])
        return rows


def summarize(traces: Mapping[str, Trace], **about_the_file: object) -> Summary:
    """Summarize a recording from its traces and information about its file."""
    joint = traces["joint"]
    wrench = traces["wrench"]
    angle, velocity, *_ = joint.newest()
    command_angle, command_velocity, *_ = traces["command"].newest()
    recent, forces = (
        rows[rows[:, 0] >= rows[:, 0].max(initial=0.0) - WINDOW_S + TICK_S / 2]
        for rows in (joint.array(), wrench.array())
    )
    span = recent[-1, 0] - recent[0, 0] if len(recent) else 0.0
    # A full window of rows spans one tick less than WINDOW_S; half a tick is tolerance.
    is_whole = len(forces) > 0 and wrench.rows[0].time <= forces[-1, 0] - WINDOW_S + 1.5 * TICK_S
    has_mean = is_whole and bool((np.abs(forces[:, 1:3]) < MAX_NUMBER).all())
    return {
        **about_the_file,
        # For the joint: the rate is over the last 2 s, and gaps are relative to 100 Hz.
        "rows": joint.count,
        "rate_hz": float((len(recent) - 1) / span) if span > 0 else None,
        "gaps": joint.gaps,
        "missing": joint.missing,
        "force_gaps": wrench.gaps,
        "force_missing": wrench.missing,
        # Number of messages that could not be decoded.
        "unreadable": sum(trace.unreadable for trace in traces.values()),
        "angle_rad": angle,
        "velocity_rad_s": velocity,
        "command_angle_rad": command_angle,
        "command_velocity_rad_s": command_velocity,
        "current_a": traces["current"].newest()[0],
        "force_n": _pair(wrench.newest()),
        "torque_nm": wrench.newest()[2],
        # Over the last 2 s; None if these are incomplete or contain an invalid force.
        "mean_force_n": _pair(forces[:, 1:].mean(axis=0).tolist()) if has_mean else None,
        "reference_n": _pair(traces["reference"].newest()),
        # Time since the recording's first row [s] and text, latest last.
        "events": [(row.time, str(row.values[0])) for row in list(traces["event"].rows)[-8:]],
    }


def counts(summary: Summary) -> str:
    """Describe rows, rate, gaps, size and damage in one line."""
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
    """Return the number; None if it is not a plausible reading."""
    return value if isinstance(value, float) and abs(value) < MAX_NUMBER else None


def _pair(values: list[float | None]) -> tuple[float, float] | None:
    x, y, *_ = values
    return None if x is None or y is None else (x, y)
