"""The last seconds of one topic, its rows counted, and the gaps between them."""

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from softfin.core.quantities import TICK_S
from softfin.rig.monitor.messages import NAMES, Values

MOST_ROWS = 30_000
"""Of one topic that are held, whatever their times say: 30 s of a sensor that streams at 1 kHz."""


class Row(NamedTuple):
    """One message."""

    serial: int
    """Its number among all that the follower has taken in."""
    time: float
    """When it was logged, since the recording's first message [s]."""
    values: Values


class Trace:
    """Rows of one topic in the order in which they were written."""

    def __init__(self, role: str) -> None:
        self.role = role
        self.rows: deque[Row] = deque(maxlen=MOST_ROWS)
        self.count = 0
        self.gaps = 0
        """Places where rows at 100 Hz are missing."""
        self.missing = 0
        """Rows that would fill them."""
        self.unreadable = 0
        self._waiting: deque[tuple[float, str, bytes]] = deque(maxlen=MOST_ROWS)
        self.last: float | None = None
        """Time of the message that came last, decoded or not [s]."""

    @property
    def newest(self) -> Row | None:
        """The row that came last."""
        return self.rows[-1] if self.rows else None

    def offer(self, time: float, kind: str, data: bytes) -> None:
        """Count a message, and hold it until `settle`."""
        self.count += 1
        if self.last is not None and time - self.last > 1.5 * TICK_S:
            self.gaps += 1
            self.missing += round((time - self.last) / TICK_S) - 1
        self.last = time
        self._waiting.append((time, kind, data))

    def settle(self, since: float, decode: Callable[[str, str, bytes], Values | None], serials: Iterator[int]) -> None:
        """Decode what was offered, from the last row before `since`: it holds until the next one comes."""
        while self._waiting:
            time, kind, data = self._waiting.popleft()
            if self._waiting and self._waiting[0][0] < since:
                continue
            values = decode(self.role, kind, data)
            if values is None:
                self.unreadable += 1
            else:
                self.rows.append(Row(next(serials), time, values))
        while len(self.rows) > 1 and self.rows[1].time < since:
            self.rows.popleft()

    def after(self, serial: int) -> list[Row]:
        """The rows that came after the one of that number."""
        found = []
        for row in reversed(self.rows):
            if row.serial <= serial:
                break
            found.append(row)
        return found[::-1]

    def array(self) -> Float64[np.ndarray, "rows channels"]:
        """Time [s] and values of the rows that are held, as messages.NAMES has them."""
        table = [(row.time, *row.values) for row in self.rows]
        return np.array(table, np.float64).reshape(len(table), 1 + len(NAMES[self.role]))
