"""The stream of an Axia80's records over UDP: counted, timed, scaled, filtered, rotated into
softfin's axes."""

import contextlib
import socket
import struct
import sys
from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.axia80.config import Axia80Config
from softfin.rig.axia80.rdt import (
    RdtCommand,
    RdtRecord,
    decode_record,
    encode_request,
    wrapped_step,
)
from softfin.rig.axia80.watch import StreamWatch
from softfin.rig.filter import AntiAlias
from softfin.rig.machine import Wrench, rotated, rotation
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket

BUFFER_BYTES = 4 * 1024 * 1024
"""Requested size of the kernel's buffer: seconds of the stream, if the process is held up. Linux
gives twice `net.core.rmem_max` at most, which by default are 0.5 s of it."""

MAX_DATAGRAMS = 1000
"""Datagrams taken at one drain. After a pause, 5,000 and more may be waiting; taking them all would
cost several ticks and trip the loop's own limit. At 8 kHz a tick brings 80, so a backlog still
shrinks."""

BACKLOG_S = 0.2
"""Age beyond the filter's length at which a record is discarded: no force that may be acted on
needs it."""

UNREAD_S = 0.03
"""Time without a look at the socket up to which a record without a usable stamp counts as new."""

DATE_STEP_S = 0.005
"""Change of the date against the monotonic clock, between two drains, from which on the date was
set. NTP slews it by 0.5 ms/s at most."""

OFFSET_TRIES = 10
"""Attempts to read the date and the monotonic clock without a delay in between."""

# Linux's own number, which Python's socket module does not name; the same on x86 and ARM.
SO_TIMESTAMPNS = 35
STAMP = struct.Struct("@ll")
"""The kernel's stamp: seconds and nanoseconds of the date."""

LATE_RECORDS = 64
"""Records by which one may be overtaken. One that comes later than that belongs to another
stream."""

MAX_GAP = 1 << 24
"""Longest gap in records: half an hour at 8 kHz. A longer jump starts another stream and counts as
no loss."""


class Arrival(NamedTuple):
    """A record and the monotonic time at which it arrived at this computer [s]."""

    record: RdtRecord
    time: float


class RdtClient:
    """Never blocks; the socket is connected, so that the kernel passes only what comes from the
    sensor's port."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self.refused = 0
        self._clock = clock
        self._date = clock.wall
        self._has_stamps = False
        self._empty_at = clock()
        """Latest moment at which the socket is known to have been empty [s]."""
        self._socket: socket.socket | SimulatedSocket
        if isinstance(clock, SimulatedClock):
            simulated = SimulatedSocket(clock, host)
            simulated.connect((host, port))
            self._socket = simulated
            self._date = simulated.date
            self._date_offset, _ = self._measure_offset()
            return
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.connect((host, port))
            self._socket.setblocking(False)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address "
                "and the network"
            ) from None
        if sys.platform.startswith("linux"):
            # While a person types "move", or a log is written, nobody reads. Linux then keeps the
            # oldest records and drops the new ones. Stamped when they are taken, they would pass
            # for fresh: a force of a minute ago, on which the motor is powered. So each record
            # carries the time at which the kernel received it.
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                self._has_stamps = True
        self._date_offset, _ = self._measure_offset()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._socket.fileno() == -1

    def send(self, command: RdtCommand) -> bool:
        """Send a command; False if the network does not take it."""
        try:
            self._socket.send(encode_request(command))
        except OSError:
            return False
        return True

    def drain(self) -> list[Arrival]:
        """Take what has arrived, at most MAX_DATAGRAMS; the oldest comes first."""
        received: list[tuple[RdtRecord, float | None]] = []
        empty_at = self._empty_at
        for _ in range(MAX_DATAGRAMS):
            looked_at = self._clock()
            try:
                data, stamp = self._receive()
            except BlockingIOError:
                # Whatever is taken later will have arrived after this moment.
                self._empty_at = looked_at
                break
            except OSError:
                # The answer to an earlier request that found no listener; the silence will tell.
                self.refused += 1
                break
            record = decode_record(data)
            if record is None:
                self.refused += 1
            else:
                received.append((record, stamp))
        offset, now = self._measure_offset()
        # A stamp is of the date, which a person or NTP may set, and which jumps after a suspend.
        # Then the stamps of this drain are worth nothing.
        is_date_set = abs(offset - self._date_offset) > DATE_STEP_S
        self._date_offset = offset
        # Without a stamp a record counts as new only if the socket was empty a moment ago, else as
        # old as it can be.
        unknown = now if now - empty_at <= UNREAD_S else empty_at
        arrivals = []
        for record, stamp in received:
            time = unknown
            if stamp is not None and not is_date_set:
                # Whatever the date is, no record came before the socket was last empty, and none
                # will come later.
                time = min(max(stamp - offset, empty_at), now)
            arrivals.append(Arrival(record, time))
        return arrivals

    def close(self) -> None:
        """Close the socket; any number of times."""
        self._socket.close()

    def _measure_offset(self) -> tuple[float, float]:
        """Return the offset of the date from the monotonic clock, and the time of that clock [s].

        On a busy computer the process may be held up between the two readings, which would look
        like a date that was set; so they are repeated until they are close together.
        """
        for _ in range(OFFSET_TRIES):
            before = self._clock()
            date = self._date()
            after = self._clock()
            if after - before < DATE_STEP_S / 10:
                break
        # If no pair is close together, this order makes records look older than they are, never
        # newer.
        return date - before, before

    def _receive(self) -> tuple[bytes, float | None]:
        """A datagram and the date at which the kernel received it [s]; None on platforms without
        such stamps."""
        if isinstance(self._socket, SimulatedSocket):
            data, stamp, _ = self._socket.receive()
            return data, stamp
        if not self._has_stamps:
            return self._socket.recv(4096), None
        data, ancillary, _, _ = self._socket.recvmsg(4096, 256)
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) == STAMP.size:
                seconds, nanoseconds = STAMP.unpack(value)
                return data, float(seconds + nanoseconds * 1e-9)
        return data, None


class StreamClock:
    """Monotonic times of places in an even stream, from noisy stamps: no record can be stamped too
    early."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        """Measured rate, once the stream has lasted 0.3 s; until then the configured one [Hz]."""
        self.measured_s = 0.0
        """Duration of the stream so far [s]."""
        # Of a tenth of a second at 100 Hz the earliest counts: a packet that was held up moves no
        # time.
        self._stamps: deque[tuple[int, float]] = deque(maxlen=12)
        self._base: tuple[int, float] | None = None

    def restart(self) -> None:
        """Forget the stamps and keep the rate: the numbers of the records jumped, perhaps without
        their time."""
        self._stamps.clear()
        self._base = None

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

    def estimate_time(self, place: int) -> float:
        """The monotonic time of a place near the newest ones [s]."""
        return min(time + (place - stamped) / self.rate_hz for stamped, time in self._stamps)


class ForceReading(NamedTuple):
    """The newest force."""

    force_time: float
    """Monotonic time of the filtered wrench [s]: the delay of the filter before its newest
    record."""
    wrench: Wrench
    peak: Wrench
    """Largest magnitudes of all unfiltered records since the read before, for safety, as the filter
    is slow."""


class ForceStream:
    """Everything received since the sensor was opened."""

    def __init__(self, config: Axia80Config, scale: list[float], clock: Clock) -> None:
        """`scale` is newton or newton metre per count, of the six channels."""
        self.client = RdtClient(config.address, config.rdt_port, clock)
        self._clock = clock
        self.filter = AntiAlias(config.rate_hz, config.cutoff_hz)
        self.times = StreamClock(config.rate_hz)
        self.watch = StreamWatch(config.rate_hz)
        self.records = self.lost = 0
        self.late = 0
        """Records that were overtaken or doubled; on one cable none is. They stay lost."""
        self.discarded = 0
        """Records that were too old when they were taken, as after a pause."""
        self.status = 0
        """Every status bit that a record of the newest arrivals had set."""
        self.taken = clock()
        """When the newest record was taken from the socket [s]: later, if the process was held
        up."""
        self.requested = clock()
        """When the stream was last requested [s]."""
        self.collected: list[Float[np.ndarray, " 6"]] | None = None
        """A list that every record is appended to, in the sensor's axes [N, N m], if a caller sets
        one."""
        self.rotation = rotation(config.frame)
        self._scale = np.array(scale)
        self._sequence: int | None = None
        """Number of the newest record in its stream."""
        self._missing = 0
        """Records before the next one that the filter did not get: lost or discarded."""
        self._force: tuple[float, Wrench] | None = None
        self._peak = np.zeros(6)

    @property
    def delay_s(self) -> float:
        """Delay of the filter [s]."""
        return self.filter.delay / self.times.rate_hz

    def request(self) -> None:
        """Request a stream: the next record is its first."""
        self.client.send(RdtCommand.START)
        self.requested = self._clock()
        self._begin()

    def take(self) -> None:
        """Take what has arrived."""
        arrivals = self.client.drain()
        if not arrivals:
            return
        self.taken = self._clock()
        self.status = 0
        oldest_useful = self.taken - 2 * self.delay_s - BACKLOG_S
        newest = None
        for record, time in arrivals:
            self.records += 1
            self.status |= record.status
            if not self._advance(record, time):
                self.late += 1
            elif time < oldest_useful:
                self.discarded += 1
                self._missing += 1
            else:
                self._put(record)
                newest = time
        if newest is not None:
            self.times.stamp(self.filter.newest, newest)

    def reading(self) -> ForceReading | None:
        """The newest force; the old one during a gap. None before there was any."""
        output = self.filter.output()
        if output is not None:
            moment = self.times.estimate_time(self.filter.newest) - self.delay_s
            # The measured rate still settles; a time that was reported is not taken back.
            latest = moment if self._force is None else max(moment, self._force[0])
            self._force = (latest, rotated(output, self.rotation))
        if self._force is None:
            return None
        # The rotation only swaps axes and signs, so that magnitudes stay magnitudes.
        peak = rotated(self._peak, np.abs(self.rotation))
        self._peak = np.zeros(6)
        return ForceReading(*self._force, peak)

    def _begin(self) -> None:
        """Start anew: what comes next must not be joined to what came before."""
        self._sequence = None
        self._missing = 0
        self.filter.clear()
        self.times.restart()

    def _advance(self, record: RdtRecord, time: float) -> bool:
        """Count a record; False if it is not newer than those before."""
        step = 1 if self._sequence is None else wrapped_step(self._sequence, record.rdt_sequence)
        if not -LATE_RECORDS <= step <= MAX_GAP:
            # The sensor started another stream. As a gap, such a jump would put the measured rate
            # in the billions.
            self._begin()
            step = 1
        if step <= 0:
            return False
        self._sequence = record.rdt_sequence
        self.lost += step - 1
        self._missing += step - 1
        self.watch.take(record, time)
        return True

    def _put(self, record: RdtRecord) -> None:
        if not self.filter.bridges(self._missing):
            # The gap may have no time of its own, if the sensor's numbers jumped.
            self.times.restart()
        values = self._scale * record.counts
        self.filter.put(values, self._missing)
        self._missing = 0
        np.maximum(self._peak, np.abs(values), out=self._peak)
        if self.collected is not None:
            self.collected.append(values)
