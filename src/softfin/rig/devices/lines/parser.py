"""Decode and number the lines, without I/O: text in, wrenches and numbers of lost lines out."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.rig.devices.lines.config import COUNTERS, LinesConfig
from softfin.rig.loss_estimate import LossEstimate, wrapped_step
from softfin.rig.machine import WRENCH_CHANNELS
from softfin.rig.stream_clock import ShortestDelay

REORDERED_LINES = 64
"""Number of lines by which a counter may go back without a restart."""

MAX_LAG_S = 0.05
"""Increase of the delay between sensor and computer that counts as a fault [s]; the loop limit on
the age of a force does not detect it."""

LAGGING_S = 0.5
"""Time for which every line must be that late [s]; single late ones are bridged."""

CLOCK_ERRORS = {"count": 0.05, "time_ms": 0.01, "time_us": 0.01}
"""Largest relative error of the sensor clock; a delay that grows more slowly cannot be
distinguished from it. For a counter, the clock is its rate, which is measured for half a second."""


class Record(NamedTuple):
    """One line."""

    wrench: Float[np.ndarray, " 6"]
    """Force and torque in the sensor axes [N, N m]; zero for channels without a column."""
    number: int | None
    """Value of the counter or of the time; None without such a column."""


class LineParser:
    """Decodes the lines of one sensor."""

    def __init__(self, config: LinesConfig) -> None:
        self._columns = config.columns
        self._separator = config.separator
        self._scale = config.scale

    def parse(self, line: bytes) -> Record | None:
        """Return the record in a line; None if it is cut, joined with another, or not numbers."""
        try:
            texts = line.decode("ascii").strip().split(self._separator)
        except UnicodeDecodeError:
            return None
        if len(texts) != len(self._columns):
            return None
        wrench = np.zeros(len(WRENCH_CHANNELS))
        number = None
        try:
            for column, text in zip(self._columns, texts, strict=True):
                if column in COUNTERS:
                    number = int(text) % 2**32
                elif column in WRENCH_CHANNELS:
                    value = float(text) * self._scale.get(column, 1.0)
                    wrench[WRENCH_CHANNELS.index(column)] = value
        except (ValueError, OverflowError):
            return None
        return Record(wrench, number) if math.isfinite(wrench.sum()) else None


class LineCounter:
    """Counts lost, repeated and late lines by their counter or time; without either, every line
    counts as the next one."""

    def __init__(self, config: LinesConfig) -> None:
        self.has_restarted = False
        """Whether the counter went back, as after a restart of the sensor."""
        self.total = 0
        """Increase of the counter or of the time since the first line, in its own unit."""
        self._rate_hz = config.rate_hz
        self._loss = LossEstimate(config.rate_hz)
        self._column = config.counter
        self._newest: int | None = None

    def steps(self, number: int | None) -> int:
        """Return by how many lines this one is later than the latest; 0 or less if it is not
        newer."""
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
    """Notices that the sensor delivers its lines ever later, e.g. because a buffer in it or on the
    way fills: they still arrive regularly, so the force looks new."""

    def __init__(self, clock_error: float) -> None:
        self.is_lagging = False
        """Whether all lines were too late for some time, once."""
        self.lag_s = 0.0
        """Increase of the delay at that moment [s]."""
        self._shortest = ShortestDelay(clock_error)
        self._lagging_since: float | None = None

    def take(self, sent: float, arrived: float) -> None:
        """Register a line that was sent at a time on the sensor clock and arrived at one on the
        computer's [s]."""
        lag_s = arrived - sent - self._shortest.update(sent, arrived)
        if lag_s <= MAX_LAG_S:
            self._lagging_since = None
            return
        if self._lagging_since is None:
            self._lagging_since = arrived
        if not self.is_lagging and arrived - self._lagging_since >= LAGGING_S:
            self.is_lagging = True
            self.lag_s = lag_s
