"""The stream of an Axia80's records: counted, put in order, timed, scaled, filtered, rotated into softfin's axes."""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.clock import Clock
from softfin.rig.axia80.client import RdtClient
from softfin.rig.axia80.config import Axia80Config
from softfin.rig.axia80.rdt import RdtRecord
from softfin.rig.filter import AntiAlias
from softfin.rig.machine import Wrench, rotated, rotation

LATE_RECORDS = 64
"""Records by which one may be overtaken; one that comes later than that begins another stream."""

MAX_GAP = 1 << 20
"""Longest gap in records; two minutes at the sensor's fastest. A longer jump begins another stream."""

KEPT_STAMPS = 12
"""Number of stamps among which the earliest counts; a tenth of a second at 100 Hz. A packet that was held up moves no
time."""

PAUSE_S = 0.2
"""Silence after which earlier stamps no longer count [s]."""

BASE_S = 0.3
"""Shortest stretch of a stream from which its rate is measured [s]."""


class SequenceCounter:
    """Gives each record a place in one row of integers that never rolls over; counts what is lost, late or doubled.

    A stream's own numbers show gaps; the sensor's, which only its power switch resets, show a restart. Both are modulo
    2^32.
    """

    def __init__(self) -> None:
        self.lost = self.late = self.streams = self.restarts = 0
        self._newest: tuple[int, int] | None = None
        """Both numbers of the newest record."""
        self._is_requested = True
        self._place = 0

    def begin(self) -> None:
        """A stream was requested: the next record is its first."""
        self._is_requested = True

    def take(self, rdt_sequence: int, ft_sequence: int) -> tuple[int, bool] | None:
        """Place of a record, and whether it begins a stream; None for one that is not newer than all before.

        On one cable nothing is overtaken or doubled; where it is, it stays lost, and is counted as late.
        """
        rdt, ft = self._newest or (rdt_sequence, ft_sequence)
        step, age = _difference(rdt_sequence, rdt), _difference(ft_sequence, ft)
        is_next = not self._is_requested and 0 < step <= MAX_GAP and age >= 0
        if is_next:
            self.lost += step - 1
            self._place += step
        elif not self._is_requested and -LATE_RECORDS < step <= 0 and age <= 0:
            self.late += 1
            return None
        else:
            self.streams += 1
            self.restarts += age < 0
            self._place += 1
            self._is_requested = False
        self._newest = rdt_sequence, ft_sequence
        return self._place, not is_next


def _difference(after: int, before: int) -> int:
    """Steps from one number to another the short way round [-2^31, 2^31)."""
    return (after - before + (1 << 31)) % (1 << 32) - (1 << 31)


class StreamClock:
    """Monotonic times of places in one even stream, from noisy stamps: no record can be stamped too early."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        """Measured rate, once the stream has lasted `BASE_S`; until then the expected one [Hz]."""
        self.measured_s = 0.0
        """Duration of the stream so far [s]."""
        self._stamps: deque[tuple[int, float]] = deque(maxlen=KEPT_STAMPS)
        self._base: tuple[int, float] | None = None

    def stamp(self, place: int, time: float) -> None:
        """The record at a place was received at a time."""
        first, began = self._base = self._base or (place, time)
        self.measured_s = time - began
        if self.measured_s >= BASE_S and place > first:
            self.rate_hz = (place - first) / self.measured_s
        if self._stamps and time - self._stamps[-1][1] > PAUSE_S:
            self._stamps.clear()
        self._stamps.append((place, time))

    def time_of(self, place: int) -> float:
        """The monotonic time of a place near the newest ones [s]."""
        return min(time + (place - stamped) / self.rate_hz for stamped, time in self._stamps)


class ForceReading(NamedTuple):
    """The newest force."""

    force_time: float
    """Monotonic time of the filtered wrench [s]: the delay of the filter before its newest record."""
    wrench: Wrench
    peak: Wrench
    """Largest magnitudes of all unfiltered records since the read before, for safety, as the filter is slow."""


class ForceStream:
    """Everything received since the sensor was opened; several streams, where it had to be asked again."""

    def __init__(self, config: Axia80Config, scale: list[float], clock: Clock) -> None:
        """`scale` is newton or newton metre per count, of the six channels."""
        self.client = RdtClient(config.address, config.rdt_port, clock)
        self._clock = clock
        self.sequence = SequenceCounter()
        self.filter = AntiAlias(config.rate_hz, config.cutoff_hz)
        self.times = StreamClock(config.rate_hz)
        self.records = 0
        self.status = 0
        """Every status bit that a record of the newest arrivals had set."""
        self.taken = clock()
        """When it was taken from the socket [s]: later, if the process was held up. Silence counts from here."""
        self.collected: list[Float[np.ndarray, " 6"]] | None = None
        """A list that every record is appended to, in the sensor's axes [N, N m], if a caller sets one."""
        self.rotation = rotation(config.frame)
        self._force: tuple[float, Wrench] | None = None
        self._scale = np.array(scale)
        self._peak = np.zeros(6)

    @property
    def delay_s(self) -> float:
        """Delay of the filter [s]."""
        return self.filter.delay / self.times.rate_hz

    def take(self) -> None:
        """Take all that has arrived."""
        records, arrived = self.client.drain()
        if records:
            self.status = 0
        places = [place for record in records if (place := self._put(record)) is not None]
        if places:
            self.taken = self._clock()
            self.times.stamp(places[-1], arrived)

    def reading(self) -> ForceReading | None:
        """The newest force; the old one during a gap. None before there was any."""
        output = self.filter.output()
        if output is not None:
            moment = self.times.time_of(self.filter.newest) - self.delay_s
            # The measured rate still settles; a time that was reported is not taken back.
            latest = moment if self._force is None else max(moment, self._force[0])
            self._force = (latest, rotated(output, self.rotation))
        if self._force is None:
            return None
        # The rotation only swaps axes and signs, so that magnitudes stay magnitudes.
        peak, self._peak = rotated(self._peak, np.abs(self.rotation)), np.zeros(6)
        return ForceReading(*self._force, peak)

    def _put(self, record: RdtRecord) -> int | None:
        """Place of the record, where it is newer than all before."""
        self.records += 1
        self.status |= record.status
        taken = self.sequence.take(record.rdt_sequence, record.ft_sequence)
        if taken is None:
            return None
        place, begins = taken
        if begins:
            self.filter.clear()
            # At the old rate until its own is measured.
            self.times = StreamClock(self.times.rate_hz)
        values = self._scale * record.counts
        self.filter.put(place, values)
        np.maximum(self._peak, np.abs(values), out=self._peak)
        if self.collected is not None:
            self.collected.append(values)
        return place
