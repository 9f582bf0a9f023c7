"""100 Hz ticks with absolute deadlines on the monotonic clock, and statistics of their lateness and
of skipped ticks."""

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import TICK_S

BIN_S = 1e-4
BINS = 1000
"""Number of bins in the lateness histogram, 0.1 ms each; the last bin includes all later ticks."""


class Pace:
    """Sleeps until each tick; a late tick does not delay subsequent ticks."""

    def __init__(self, clock: Clock = REAL) -> None:
        self.clock = clock
        self.ticks = 0
        """Number of ticks so far."""
        self.skipped = 0
        """Number of periods without a tick; skipped ticks are not made up for."""
        self._late = np.zeros(BINS, int)
        self._latest = 0.0
        self.start()

    def start(self) -> None:
        """Schedule the first tick one period from now."""
        self._next = self.clock() + TICK_S

    def wait(self) -> float:
        """Sleep until the next tick; return its lateness [s], including skipped ticks."""
        while (left := self._next - self.clock()) > 0:
            self.clock.sleep(left)
        late = self.clock() - self._next
        skipped = int(late / TICK_S)
        # Stay on the grid of absolute deadlines; missed ticks are skipped instead of run in a
        # burst.
        self._next += (1 + skipped) * TICK_S
        self.ticks += 1
        self.skipped += skipped
        self._late[min(BINS - 1, int(late / BIN_S))] += 1
        self._latest = max(self._latest, late)
        return late

    def to_dict(self) -> dict[str, int | float]:
        """Return the counts and the median, 99th percentile and maximum of the lateness for JSON;
        percentiles have a resolution of 0.1 ms."""
        # A percentile is the upper edge of its bin, but at most the maximum.
        reached = np.cumsum(self._late)
        p50, p99 = (
            min(
                (int(np.searchsorted(reached, max(1.0, part * self.ticks))) + 1) * BIN_S,
                self._latest,
            )
            for part in (0.5, 0.99)
        )
        milliseconds = {"late_p50_ms": p50, "late_p99_ms": p99, "late_max_ms": self._latest}
        return {"ticks": self.ticks, "skipped_ticks": self.skipped} | {
            name: round(late * 1e3, 3) for name, late in milliseconds.items()
        }
