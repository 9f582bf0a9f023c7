"""The 100 Hz ticks: absolute deadlines on the monotonic clock, with lateness and skipped ticks counted."""

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import TICK_S

BIN_S = 1e-4
BINS = 1000
"""Bins of the histogram of lateness: 0.1 ms each, the last one for everything later."""


class Pace:
    """Sleeps until each tick; a tick that comes late does not delay the next ones."""

    def __init__(self, period: float = TICK_S, clock: Clock = REAL) -> None:
        self.period, self.clock = period, clock
        self.ticks = 0
        """Ticks waited for so far."""
        self.skipped = 0
        """Whole periods that passed without a tick; they are not made up for."""
        self._late = np.zeros(BINS, int)
        self._latest = 0.0
        self._next: float | None = None

    def start(self) -> None:
        """Put the first tick one period from now."""
        self._next = self.clock() + self.period

    def wait(self) -> float:
        """Sleep until the next tick; returns how late it is [s], skipped ticks included."""
        due = self.clock() + self.period if self._next is None else self._next
        while (left := due - self.clock()) > 0:
            self.clock.sleep(left)
        late = self.clock() - due
        skipped = int(late / self.period)
        self._next = due + (1 + skipped) * self.period
        self.ticks += 1
        self.skipped += skipped
        self._late[min(BINS - 1, int(late / BIN_S))] += 1
        self._latest = max(self._latest, late)
        return late

    def to_dict(self) -> dict[str, int | float]:
        """Return counts, and the lateness that half and 99% of all ticks do not exceed, to 0.1 ms, for JSON."""
        reached = np.cumsum(self._late)
        p50, p99 = (
            min((int(np.searchsorted(reached, max(1.0, part * self.ticks))) + 1) * BIN_S, self._latest)
            for part in (0.5, 0.99)
        )
        return {
            "ticks": self.ticks,
            "skipped_ticks": self.skipped,
            "late_p50_ms": round(p50 * 1e3, 3),
            "late_p99_ms": round(p99 * 1e3, 3),
            "late_max_ms": round(self._latest * 1e3, 3),
        }
