"""The 100 Hz clock: absolute deadlines on the monotonic clock, with lateness and skipped ticks counted."""

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import TICK_S

BIN_S = 1e-4
BINS = 1000
"""Of the histogram of lateness: 0.1 ms each, the last one for all that is later."""


class Pace:
    """Sleeps until each tick; a tick that comes late does not delay the next ones."""

    def __init__(self, period: float = TICK_S, clock: Clock = REAL) -> None:
        self.period, self.clock = period, clock
        self.ticks = 0
        """Waited for so far."""
        self.skipped = 0
        """Whole periods that passed while nobody waited: what was due then is not made up for."""
        self._late = [0] * BINS
        self._worst = 0.0
        self._next: float | None = None

    def start(self) -> None:
        """The first tick is one period from now."""
        self._next = self.clock() + self.period

    def wait(self) -> float:
        """Sleep until the next tick; returns how late it is [s], skipped ticks included."""
        if self._next is None:
            self.start()
        due = self._next
        assert due is not None
        while (left := due - self.clock()) > 0:
            self.clock.sleep(left)
        late = self.clock() - due
        missed = int(late / self.period)
        self._next = due + (1 + missed) * self.period
        self.ticks += 1
        self.skipped += missed
        self._late[min(BINS - 1, int(late / BIN_S))] += 1
        self._worst = max(self._worst, late)
        return late

    def lateness(self, part: float) -> float:
        """The lateness [s] that this part of all ticks does not exceed, to 0.1 ms; 0 before the first tick."""
        seen = 0
        for index, count in enumerate(self._late):
            seen += count
            if seen and seen >= part * self.ticks:
                return min((index + 1) * BIN_S, self._worst)
        return self._worst

    def described(self) -> dict[str, int | float]:
        """For JSON."""
        return {
            "ticks": self.ticks,
            "skipped_ticks": self.skipped,
            "late_p50_ms": round(self.lateness(0.5) * 1e3, 3),
            "late_p99_ms": round(self.lateness(0.99) * 1e3, 3),
            "late_max_ms": round(self._worst * 1e3, 3),
        }
