"""The last seconds of one topic of a recording: its rows counted, the gaps found, its messages decoded when needed."""

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64

from softfin.core.printable import printable
from softfin.core.quantities import TICK_S
from softfin.storage.bag.messages import (
    COMMAND,
    CURRENT,
    EVENTS,
    JOINT,
    JOINT_STATE,
    REFERENCE,
    TYPES,
    WRENCH,
    WRENCH_STAMPED,
    type_store,
)

MOST_ROWS = 30_000
"""Rows of one topic that are held, whatever their times say: 30 s of a sensor that streams at 1 kHz."""

MOST_CHARACTERS = 300
"""Characters of an event's text that are shown."""

Values: TypeAlias = tuple[float | str, ...]


class Role(NamedTuple):
    """What a topic holds."""

    topic: str
    columns: tuple[str, ...]


ROLES = {
    "joint": Role(JOINT, ("angle_rad", "velocity_rad_s")),
    "wrench": Role(WRENCH, ("force_x_n", "force_y_n")),
    "command": Role(COMMAND, ("angle_rad", "velocity_rad_s")),
    "reference": Role(REFERENCE, ("force_x_n", "force_y_n")),
    "current": Role(CURRENT, ("current_a",)),
    "event": Role(EVENTS, ("text",)),
}


def decode_message(role: str, type_name: str, data: bytes) -> Values | None:
    """Return the values of a message; None where it is of another type than softfin records, or damaged."""
    if type_name != TYPES[ROLES[role].topic]:
        return None
    try:
        message: Any = type_store().deserialize_cdr(data, type_name)
        if type_name == JOINT_STATE:
            velocity = float(message.velocity[0]) if len(message.velocity) else float("nan")
            return float(message.position[0]), velocity
        if type_name == WRENCH_STAMPED:
            return float(message.wrench.force.x), float(message.wrench.force.y)
        return (printable(message.data, most=MOST_CHARACTERS) if role == "event" else float(message.data),)
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
    """Rows of one topic in the order in which they were written."""

    def __init__(self, role: str) -> None:
        self.role = role
        self.rows: deque[TraceRow] = deque(maxlen=MOST_ROWS)
        self.count = 0
        self.gaps = 0
        """Places where rows at 100 Hz are missing."""
        self.missing = 0
        """Rows that would fill them."""
        self.unreadable = 0
        self.last: float | None = None
        """Time of the message that came last, decoded or not [s]."""
        self._waiting: deque[tuple[float, str, bytes]] = deque(maxlen=MOST_ROWS)

    @property
    def newest(self) -> TraceRow | None:
        """The row that came last."""
        return self.rows[-1] if self.rows else None

    def offer(self, time: float, type_name: str, data: bytes) -> None:
        """Count a message, and hold it until `settle`."""
        self.count += 1
        if self.last is not None and time - self.last > 1.5 * TICK_S:
            self.gaps += 1
            self.missing += round((time - self.last) / TICK_S) - 1
        self.last = time
        self._waiting.append((time, type_name, data))

    def settle(self, since: float, serials: Iterator[int]) -> None:
        """Decode what was offered, from the last row before `since` on: it holds until the next one comes."""
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

    def after(self, serial: int) -> list[TraceRow]:
        """Return the rows that came after the one of that number."""
        return [row for row in self.rows if row.serial > serial]

    def array(self) -> Float64[np.ndarray, "rows channels"]:
        """Return time [s] and values of the rows that are held, with the columns of the role."""
        table = [(row.time, *row.values) for row in self.rows]
        return np.array(table, np.float64).reshape(len(table), 1 + len(ROLES[self.role].columns))
