"""Times of the records in a sensor stream, estimated from noisy timestamps or a second clock."""

from collections import deque


class StreamClock:
    """Monotonic times of records in an evenly spaced stream, from noisy timestamps, which can only
    be too late."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        """Measured rate once the stream has lasted 0.3 s, and the configured rate before [Hz]."""
        self.measured_s = 0.0
        """Duration of the stream so far [s]."""
        # The earliest estimate from the last 12 timestamps (about 0.1 s at one per tick) is used so
        # that a delayed packet does not shift the times.
        self._stamps: deque[tuple[int, float]] = deque(maxlen=12)
        self._base: tuple[int, float] | None = None

    def restart(self) -> None:
        """Forget the timestamps but keep the rate, because the record numbers have jumped, possibly
        by more than the elapsed time."""
        self._stamps.clear()
        self._base = None

    def stamp(self, place: int, time: float) -> None:
        """Register that the record at position `place` was received at `time` [s]."""
        first, began = self._base = self._base or (place, time)
        self.measured_s = time - began
        if self.measured_s >= 0.3 and place > first:
            self.rate_hz = (place - first) / self.measured_s
        if self._stamps and time - self._stamps[-1][1] > 0.2:
            # After a silence, earlier timestamps are outdated.
            self._stamps.clear()
        self._stamps.append((place, time))

    def estimate_time(self, place: int) -> float:
        """Return the monotonic time of a position near the latest positions [s]."""
        # Every timestamp is late by an unknown delay, so the earliest estimate is the best.
        return min(time + (place - stamped) / self.rate_hz for stamped, time in self._stamps)


class ShortestDelay:
    """Difference between two clocks, estimated from the message with the shortest delay.

    The minimum is relaxed slowly, so that it follows clocks with different rates.
    """

    def __init__(self, clock_error: float) -> None:
        self._clock_error = clock_error
        """Maximum relative difference between the rates of the clocks."""
        self._lowest: float | None = None
        self._received = 0.0

    def update(self, sent: float, received: float) -> float:
        """Return the difference [s] after a message, given its send time on the other clock and its
        reception time on our clock [s]."""
        difference = received - sent
        if self._lowest is not None:
            relaxed = self._lowest + self._clock_error * (received - self._received)
            difference = min(difference, relaxed)
        self._lowest = difference
        self._received = received
        return difference
