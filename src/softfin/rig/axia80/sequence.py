"""Book-keeping of a stream of records: which are lost, late or doubled, and when the sensor or the stream began anew.

A stream's own numbers tell gaps; the sensor's, which only its power switch resets, tell a restart. Both are
modulo 2^32.
"""

import enum
from collections import deque

WINDOW = 1024
"""Records back that are remembered, to tell a late one from a doubled one."""

LONGEST_GAP = 1 << 20
"""Records; two minutes at the sensor's fastest. What jumps further is another stream."""


class Arrival(enum.Enum):
    """What a record is to the ones before it."""

    NEXT = "next"
    """Newer than all before it, with or without a gap."""
    LATE = "late"
    DUPLICATE = "duplicate"
    NEW_STREAM = "new stream"
    """The first, or the first after somebody asked anew."""
    RESTART = "restart"
    """The first after the sensor was switched off and on."""


class SequenceCounter:
    """Takes the two numbers of each record, gives each a place in one row of integers that never rolls over."""

    def __init__(self) -> None:
        self.lost = self.late = self.duplicates = self.streams = self.restarts = 0
        self._rdt: int | None = None
        self._ft: int | None = None
        self._index = self._first = 0
        self._seen: dict[int, int] = {}
        self._order: deque[int] = deque()

    def begin(self) -> None:
        """A stream was asked for: whatever comes next is its first record."""
        self._rdt = None

    def take(self, rdt_sequence: int, ft_sequence: int) -> tuple[Arrival, int]:
        """What the record is, and its place in the row."""
        if self._rdt is None or self._ft is None:
            fell = self._ft is not None and _step(self._ft, ft_sequence) < 0
            return self._anew(rdt_sequence, ft_sequence, fell)
        step, age = _step(self._rdt, rdt_sequence), _step(self._ft, ft_sequence)
        if step > 0:
            if age < 0 or step > LONGEST_GAP:
                return self._anew(rdt_sequence, ft_sequence, age < 0)
            self.lost += step - 1
            self._index += step
            self._rdt, self._ft = rdt_sequence, ft_sequence
            self._remember(rdt_sequence, ft_sequence)
            return Arrival.NEXT, self._index
        known = self._seen.get(rdt_sequence)
        if known == ft_sequence:
            self.duplicates += 1
            return Arrival.DUPLICATE, self._index + step
        if age > 0 or known is not None or (step <= -WINDOW and rdt_sequence <= WINDOW):
            return self._anew(rdt_sequence, ft_sequence, age < 0)
        self.late += 1
        if step > -WINDOW and self._index + step > self._first:
            self.lost -= 1
            self._remember(rdt_sequence, ft_sequence)
        return Arrival.LATE, self._index + step

    def _anew(self, rdt_sequence: int, ft_sequence: int, restarted: bool) -> tuple[Arrival, int]:
        self.streams += 1
        self.restarts += restarted
        self._index += 1
        self._first = self._index
        self._rdt, self._ft = rdt_sequence, ft_sequence
        self._seen.clear()
        self._order.clear()
        self._remember(rdt_sequence, ft_sequence)
        return (Arrival.RESTART if restarted else Arrival.NEW_STREAM), self._index

    def _remember(self, rdt_sequence: int, ft_sequence: int) -> None:
        self._seen[rdt_sequence] = ft_sequence
        self._order.append(rdt_sequence)
        if len(self._order) > WINDOW:
            del self._seen[self._order.popleft()]


def _step(before: int, after: int) -> int:
    """From one number to another the short way round [-2^31, 2^31)."""
    return (after - before + (1 << 31)) % (1 << 32) - (1 << 31)
