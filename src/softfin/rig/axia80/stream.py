"""What is made of an Axia80's records: counted, put in order, scaled, filtered, turned into softfin's axes, timed."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.rig.axia80.clock import StreamClock
from softfin.rig.axia80.config import SensorConfig, rotation
from softfin.rig.axia80.rdt import Record
from softfin.rig.axia80.sequence import Arrival, SequenceCounter
from softfin.rig.axia80.socket import Datagram, RdtSocket
from softfin.rig.axia80.status import BUSY_BIT, decode_status
from softfin.rig.axia80.xml import SensorSettings
from softfin.rig.filter import AntiAlias
from softfin.rig.machine import Wrench


class ForceReading(NamedTuple):
    """The newest that is known of the force."""

    force_time: float
    """Monotonic time that the filtered wrench stands for [s]: the delay of the filter before its newest record."""
    wrench: Wrench
    peak: Wrench
    """Largest sizes of all unfiltered records since the read before: what safety looks at, as the filter is slow."""
    received: float
    """When the newest record arrived [s]."""
    records: int
    """That came with this read."""


class ForceStream:
    """All that is known since the sensor was opened; several streams, where it had to be asked again."""

    def __init__(self, config: SensorConfig, settings: SensorSettings, opened: float) -> None:
        self.sequence = SequenceCounter()
        self.filter = AntiAlias(config.rate_hz, config.cutoff_hz)
        self.times = StreamClock(config.rate_hz)
        self.records = self.error_records = self.busy_records = 0
        self.status = 0
        """Every bit that a record of the newest arrivals had set."""
        self.received = opened
        """When the newest record arrived [s]; until there is one, when the sensor was opened."""
        self.heard = opened
        """When it was taken [s]: later, where nobody came to take it. Silence counts from here."""
        self.collected: list[Float[np.ndarray, " 6"]] | None = None
        """Where records are kept as well, in the sensor's axes [N, N m], for whoever sets a list here."""
        self._force: tuple[float, Wrench] | None = None
        self._scale = np.repeat([settings.newton_per_count, settings.newton_metre_per_count], 3)
        self._rotation = rotation(config.frame)
        self._peak = np.zeros(6)

    @property
    def delay_s(self) -> float:
        """Of the filter [s]."""
        return self.filter.delay / self.times.rate_hz

    @property
    def full(self) -> bool:
        """Enough records came one after the other for a filtered force."""
        return self.filter.full(self.filter.newest)

    def take(self, receiver: RdtSocket) -> int:
        """All that has arrived; how many records."""
        datagrams = receiver.drain()
        newest: tuple[int, Datagram] | None = None
        status = 0
        for datagram in datagrams:
            for record in datagram.records:
                status |= record.status
                place = self._place(record)
                if place is not None:
                    newest = (place, datagram)
        if datagrams:
            self.status = status
        if newest is not None:
            self.received = receiver.received_at(newest[1])
            self.heard = receiver.drained
            self.times.stamp(newest[0], self.received)
        return sum(len(datagram.records) for datagram in datagrams)

    def reading(self, at: float | None, records: int) -> ForceReading | None:
        """The newest force, or that of records up to a moment [s] near it; the old one where nothing new can be told.

        None before there was any.
        """
        if self.full:
            newest = self.filter.newest
            back = 0.0 if at is None else max(0.0, self.times.time_of(newest) - at) * self.times.rate_hz
            output = self.filter.at(newest - back)
            if output is not None:
                moment = self.times.time_of(newest - back) - self.delay_s
                # The measured rate still settles; a time that has been told is not taken back.
                latest = moment if self._force is None else max(moment, self._force[0])
                self._force = (latest, self.turned(output))
        if self._force is None:
            return None
        peak, self._peak = self._sizes(self._peak), np.zeros(6)
        return ForceReading(*self._force, peak, self.received, records)

    def _sizes(self, sizes: Float[np.ndarray, " 6"]) -> Wrench:
        """In softfin's axes; the turn swaps axes and signs alone, so that sizes stay sizes."""
        x, y, z = (np.abs(self._rotation) @ sizes[:3]).tolist()
        torque_x, torque_y, torque_z = (np.abs(self._rotation) @ sizes[3:]).tolist()
        return x, y, z, torque_x, torque_y, torque_z

    def turned(self, values: Float[np.ndarray, " 6"]) -> Wrench:
        """From the sensor's axes into softfin's."""
        x, y, z = (self._rotation @ values[:3]).tolist()
        torque_x, torque_y, torque_z = (self._rotation @ values[3:]).tolist()
        return x, y, z, torque_x, torque_y, torque_z

    def _place(self, record: Record) -> int | None:
        """The record's place, where it is newer than all before."""
        self.records += 1
        self.error_records += bool(decode_status(record.status).errors) if record.status else 0
        self.busy_records += record.status >> BUSY_BIT & 1
        arrival, place = self.sequence.take(record.rdt_sequence, record.ft_sequence)
        if arrival is Arrival.DUPLICATE:
            return None
        if arrival in (Arrival.NEW_STREAM, Arrival.RESTART):
            self.filter.clear()
            self.times.begin()
        values = self._scale * record.counts
        self.filter.put(place, values)
        np.maximum(self._peak, np.abs(values), out=self._peak)
        if self.collected is not None:
            self.collected.append(values)
        return None if arrival is Arrival.LATE else place
