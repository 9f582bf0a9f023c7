"""The stream of an Axia80's records over UDP: counted, timed, scaled, filtered, rotated into softfin's axes."""

import socket
from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.axia80.config import Axia80Config
from softfin.rig.axia80.rdt import RdtCommand, RdtRecord, decode_record, encode_request
from softfin.rig.filter import AntiAlias
from softfin.rig.machine import Wrench, rotated, rotation
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket


class RdtClient:
    """Never blocks; the socket is connected, so that the kernel passes only what comes from the sensor's port."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self.refused = 0
        self._clock = clock
        self._socket: socket.socket | SimulatedSocket
        if isinstance(clock, SimulatedClock):
            self._socket = SimulatedSocket(clock, host)
            self._socket.connect((host, port))
            return
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # Seconds of the stream, should the process be held up. Linux gives twice `net.core.rmem_max` at most.
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * 1024 * 1024)
            self._socket.connect((host, port))
            self._socket.setblocking(False)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address and the network"
            ) from None

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._socket.fileno() == -1

    def send(self, command: RdtCommand) -> bool:
        """Send a command; False where the network does not take it."""
        try:
            self._socket.send(encode_request(command))
        except OSError:
            return False
        return True

    def drain(self) -> tuple[list[RdtRecord], float]:
        """All records that have arrived, and when the last of them did [s]: not earlier, at most a record later."""
        records: list[RdtRecord] = []
        arrived = self._clock()
        while True:
            try:
                if isinstance(self._socket, SimulatedSocket):
                    data, stamp, _ = self._socket.receive()
                else:
                    data, stamp = self._socket.recv(4096), self._clock()
            except (BlockingIOError, InterruptedError):
                return records, arrived
            except OSError:
                # The answer to an earlier request that found no listener; the silence will tell.
                self.refused += 1
                return records, arrived
            record = decode_record(data)
            if record is None:
                self.refused += 1
            else:
                records.append(record)
                arrived = stamp

    def close(self) -> None:
        """Close the socket; any number of times."""
        self._socket.close()


class StreamClock:
    """Monotonic times of places in an even stream, from noisy stamps: no record can be stamped too early."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        """Measured rate, once the stream has lasted 0.3 s; until then the configured one [Hz]."""
        self.measured_s = 0.0
        """Duration of the stream so far [s]."""
        # Of a tenth of a second at 100 Hz the earliest counts: a packet that was held up moves no time.
        self._stamps: deque[tuple[int, float]] = deque(maxlen=12)
        self._base: tuple[int, float] | None = None

    def stamp(self, place: int, time: float) -> None:
        """The record at a place was received at a time."""
        first, began = self._base = self._base or (place, time)
        self.measured_s = time - began
        if self.measured_s >= 0.3 and place > first:
            self.rate_hz = (place - first) / self.measured_s
        if self._stamps and time - self._stamps[-1][1] > 0.2:
            # After a silence earlier stamps no longer count.
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
    """Everything received since the sensor was opened."""

    def __init__(self, config: Axia80Config, scale: list[float], clock: Clock) -> None:
        """`scale` is newton or newton metre per count, of the six channels."""
        self.client = RdtClient(config.address, config.rdt_port, clock)
        self._clock = clock
        self.filter = AntiAlias(config.rate_hz, config.cutoff_hz)
        self.times = StreamClock(config.rate_hz)
        self.records = self.lost = 0
        self.late = 0
        """Records that were overtaken or doubled; on one cable none is. They stay lost."""
        self.status = 0
        """Every status bit that a record of the newest arrivals had set."""
        self.taken = clock()
        """When the newest record was taken from the socket [s]: later, if the process was held up."""
        self.collected: list[Float[np.ndarray, " 6"]] | None = None
        """A list that every record is appended to, in the sensor's axes [N, N m], if a caller sets one."""
        self.rotation = rotation(config.frame)
        self._scale = np.array(scale)
        self._sequence: int | None = None
        """Number of the newest record in its stream."""
        self._force: tuple[float, Wrench] | None = None
        self._peak = np.zeros(6)

    @property
    def delay_s(self) -> float:
        """Delay of the filter [s]."""
        return self.filter.delay / self.times.rate_hz

    def request(self) -> None:
        """Request a stream: the next record is its first."""
        self.client.send(RdtCommand.START)
        self._sequence = None

    def take(self) -> None:
        """Take all that has arrived."""
        records, arrived = self.client.drain()
        if records:
            self.status = 0
        before = self.filter.newest
        for record in records:
            self._put(record)
        if self.filter.newest > before:
            self.taken = self._clock()
            self.times.stamp(self.filter.newest, arrived)

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

    def _put(self, record: RdtRecord) -> None:
        self.records += 1
        self.status |= record.status
        # Numbers roll over: the short way round counts.
        step = 1 if self._sequence is None else (record.rdt_sequence - self._sequence + 2**31) % 2**32 - 2**31
        if step <= 0:
            self.late += 1
            return
        self._sequence = record.rdt_sequence
        self.lost += step - 1
        values = self._scale * record.counts
        self.filter.put(values, step - 1)
        np.maximum(self._peak, np.abs(values), out=self._peak)
        if self.collected is not None:
            self.collected.append(values)
