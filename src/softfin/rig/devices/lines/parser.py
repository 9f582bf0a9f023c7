"""Decodes lines of text to wrenches and counts lost lines, without I/O."""

import math
from typing import NamedTuple

import numpy as np

from softfin.rig.devices.lines.config import COUNTERS, LinesConfig
from softfin.rig.loss_estimate import LossEstimate, wrapped_step
from softfin.rig.machine import WRENCH_CHANNELS, WrenchArray
from softfin.rig.stream_clock import ShortestDelay

REORDERED_LINES = 64
"""Maximum number of lines by which a counter may go back without a restart."""

MAX_LAG_S = 0.05
"""Increase in the delay between sensor and computer that is treated as a fault [s]; the age limit
for forces in the loop does not detect it."""

LAGGING_S = 0.5
"""Time for which every line must be this late [s]; single late lines are bridged."""

CLOCK_ERRORS = {"count": 0.05, "time_ms": 0.01, "time_us": 0.01}
"""Maximum relative error of the sensor clock; a delay that grows more slowly cannot be
distinguished from this error. For a counter, the clock is the line rate, which is measured for half
a second."""


class Record(NamedTuple):
    """One line."""

    wrench: WrenchArray
    """Force and torque in the sensor axes [N, N m]; zero for channels without a column."""
    number: int | None
    """Value of the counter or time column; None if there is no such column."""


def parse_line(line: bytes, config: LinesConfig) -> Record | None:
    """Return the record in a line; None if it is cut, joined with another, or not numbers."""
    wrench = np.zeros(len(WRENCH_CHANNELS))
    number = None
    # Errors of the decoder are ValueErrors, as are a missing and a surplus column.
    try:
        texts = line.decode("ascii").strip().split(config.separator)
        for column, text in zip(config.columns, texts, strict=True):
            if column in COUNTERS:
                number = int(text) % 2**32
            elif column in WRENCH_CHANNELS:
                value = float(text) * config.scale.get(column, 1.0)
                wrench[WRENCH_CHANNELS.index(column)] = value
    except (ValueError, OverflowError):
        return None
    return Record(wrench, number) if math.isfinite(wrench.sum()) else None


class LineCounter:
    """Counts lost, repeated and late lines by their counter or time; without either, every line is
    treated as the next line."""

    def __init__(self, config: LinesConfig) -> None:
        self.has_restarted = False
        """Whether the counter went back, as after a restart of the sensor."""
        self.total = 0
        """Increase of the counter or time since the first line, in the unit of the column."""
        self._rate_hz = config.rate_hz
        self._loss = LossEstimate(config.rate_hz)
        self._column = config.counter
        self._newest: int | None = None

    def steps(self, number: int | None) -> int:
        """Return the number of lines by which this line is later than the latest line; 0 or less if
        it is not newer."""
        if number is None:
            return 1
        before = self._newest
        if before is None:
            self._newest = number
            return 1
        change = wrapped_step(before, number)
        steps = change
        if self._column != "count":
            seconds = change * COUNTERS[self._column or "count"]
            steps = round(seconds * self._rate_hz)
            if change > 0:
                steps = 1 + self._loss.missing(seconds)
        if steps < -REORDERED_LINES:
            self.has_restarted = True
            steps = 1
        if change > 0 or self.has_restarted:
            self._newest = number
            self.total += max(change, 0)
        return steps


class LagWatch:
    """Detects that lines arrive with a growing delay, e.g. because a buffer in the sensor or on the
    way fills up. The lines still arrive regularly, so the force would seem new."""

    def __init__(self, clock_error: float) -> None:
        self.is_lagging = False
        """Whether all lines have ever been too late for `LAGGING_S`."""
        self.lag_s = 0.0
        """Increase of the delay at that moment [s]."""
        self._shortest = ShortestDelay(clock_error)
        self._lagging_since: float | None = None

    def take(self, sent: float, arrived: float) -> None:
        """Register a line by its send time on the sensor clock and its arrival time on the computer
        clock [s]."""
        lag_s = arrived - sent - self._shortest.update(sent, arrived)
        if lag_s <= MAX_LAG_S:
            self._lagging_since = None
            return
        if self._lagging_since is None:
            self._lagging_since = arrived
        if not self.is_lagging and arrived - self._lagging_since >= LAGGING_S:
            self.is_lagging = True
            self.lag_s = lag_s
