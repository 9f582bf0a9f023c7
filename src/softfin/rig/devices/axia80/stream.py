"""Stream of an Axia80's records over UDP: counted, timed, scaled, filtered and rotated into
softfin's axes."""

import contextlib
import socket
import struct
import sys
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import DeviceError
from softfin.rig.computer import Computer
from softfin.rig.device import ForceReading
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.rdt import (
    RdtCommand,
    RdtRecord,
    decode_record,
    encode_request,
    wrapped_step,
)
from softfin.rig.devices.axia80.watch import StreamWatch
from softfin.rig.filter import AntiAlias
from softfin.rig.machine import Wrench, rotated, rotation
from softfin.rig.stream_clock import StreamClock

BUFFER_BYTES = 4 * 1024 * 1024
"""Requested size of the kernel's receive buffer: seconds of the stream, in case the process is
delayed. Linux grants at most twice `net.core.rmem_max`, 0.5 s of the stream by default."""

MAX_DATAGRAMS = 1000
"""Maximum number of datagrams per call to `drain`. After a pause, 5,000 or more may be waiting;
processing them all would take several ticks and trip the loop's overrun limit. At 8 kHz, 80 arrive
per tick, so a backlog still shrinks."""

BACKLOG_S = 0.2
"""Age beyond the filter's length at which a record is discarded [s]: it is too old to affect a
usable force."""

UNREAD_S = 0.03
"""Longest time since the socket was empty for which a record without a usable timestamp counts as
new [s]."""

DATE_STEP_S = 0.005
"""Change in the offset between the wall clock and the monotonic clock from one drain to the next,
above which the wall clock counts as having been set [s]. NTP slews it by at most 0.5 ms/s."""

OFFSET_TRIES = 10
"""Number of attempts to read the wall clock and the monotonic clock without a delay in between."""

# Linux socket option that Python's socket module does not define; its number is the same on x86 and
# ARM.
SO_TIMESTAMPNS = 35
STAMP = struct.Struct("@ll")
"""The kernel's timestamp: seconds and nanoseconds of the wall clock."""

LATE_RECORDS = 64
"""Maximum number of records by which a record may be late; beyond that, it belongs to another
stream."""

MAX_GAP = 1 << 24
"""Longest gap [records]: half an hour at 8 kHz. A longer jump starts another stream and is not
counted as loss."""


class Arrival(NamedTuple):
    """A record and its monotonic arrival time at this computer [s]."""

    record: RdtRecord
    time: float


class RdtClient:
    """Non-blocking UDP client; its socket is connected, so that the kernel delivers only datagrams
    from the sensor's port."""

    def __init__(self, host: str, port: int, clock: Computer) -> None:
        self.refused = 0
        self._clock = clock
        self._has_stamps = False
        self._empty_at = clock()
        """Latest time at which the socket is known to have been empty [s]."""
        self._socket = clock.udp_socket()
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.connect((host, port))
            self._socket.settimeout(0)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address "
                "and the network"
            ) from None
        if sys.platform.startswith("linux"):
            # The socket is not read while the operator types "move" or a log is written. Linux then
            # keeps the oldest records and drops the new ones. If they were timestamped on reading,
            # a force from a minute ago would look current, and the motor would be powered based on
            # it. So use the time at which the kernel received each record.
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
                self._has_stamps = True
        self._date_offset, _ = self._measure_offset()

    @property
    def closed(self) -> bool:
        """Whether `close` has been called."""
        return self._socket.fileno() == -1

    def send(self, command: RdtCommand) -> bool:
        """Send a command; return False if the network does not accept it."""
        try:
            self._socket.send(encode_request(command))
        except OSError:
            return False
        return True

    def drain(self) -> list[Arrival]:
        """Return the records received, oldest first, from at most MAX_DATAGRAMS datagrams."""
        received: list[tuple[RdtRecord, float | None]] = []
        empty_at = self._empty_at
        for _ in range(MAX_DATAGRAMS):
            looked_at = self._clock()
            try:
                data, stamp = self._receive()
            except BlockingIOError:
                # Any datagram received later has arrived after this time.
                self._empty_at = looked_at
                break
            except OSError:
                # An ICMP error: an earlier request found no listener. `Axia80.complaints` reports
                # the missing records.
                self.refused += 1
                break
            record = decode_record(data)
            if record is None:
                self.refused += 1
            else:
                received.append((record, stamp))
        offset, now = self._measure_offset()
        # Timestamps are from the wall clock, which a user or NTP may set and which jumps after a
        # suspend. The timestamps of this drain are then useless.
        is_date_set = abs(offset - self._date_offset) > DATE_STEP_S
        self._date_offset = offset
        # Without a timestamp, a record counts as new only if the socket was empty a moment ago;
        # otherwise assume the maximum possible age.
        unknown = now if now - empty_at <= UNREAD_S else empty_at
        arrivals = []
        for record, stamp in received:
            time = unknown
            if stamp is not None and not is_date_set:
                # Regardless of the wall clock, each record arrived after the socket was last empty
                # and before now.
                time = min(max(stamp - offset, empty_at), now)
            arrivals.append(Arrival(record, time))
        return arrivals

    def close(self) -> None:
        """Close the socket; may be called repeatedly."""
        self._socket.close()

    def _measure_offset(self) -> tuple[float, float]:
        """Return the offset of the wall clock from the monotonic clock, and the monotonic time [s].

        On a busy computer the process may be interrupted between the two readings, which would look
        like a change of the wall clock; so they are repeated until they are close together.
        """
        for _ in range(OFFSET_TRIES):
            before = self._clock()
            date = self._clock.wall()
            after = self._clock()
            if after - before < DATE_STEP_S / 10:
                break
        # If no pair is close together, subtracting the earlier reading makes records look older
        # than they are, never newer.
        return date - before, before

    def _receive(self) -> tuple[bytes, float | None]:
        """Return a datagram and the wall-clock time at which the kernel received it [s]; None on
        platforms without such timestamps."""
        if not self._has_stamps:
            return self._socket.recvfrom(4096)[0], None
        data, ancillary, _, _ = self._socket.recvmsg(4096, 256)
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) == STAMP.size:
                seconds, nanoseconds = STAMP.unpack(value)
                return data, float(seconds + nanoseconds * 1e-9)
        return data, None


class ForceStream:
    """Processed stream since the sensor was opened."""

    def __init__(self, config: Axia80Config, scale: list[float], clock: Computer) -> None:
        """`scale` of the six channels [N/count, N m/count]."""
        self.client = RdtClient(config.address, config.rdt_port, clock)
        self._clock = clock
        self.filter = AntiAlias(config.rate_hz, config.cutoff_hz)
        self.times = StreamClock(config.rate_hz)
        self.watch = StreamWatch(config.rate_hz)
        self.records = self.lost = 0
        self.late = 0
        """Records out of order or duplicated, which does not happen on a single cable. They still
        count as lost."""
        self.discarded = 0
        """Records that were too old when received, e.g. after a pause."""
        self.status = 0
        """Status bits set in any of the latest records."""
        self.taken = clock()
        """Time at which the latest record was read from the socket [s]; later than its arrival if
        the process was delayed."""
        self.requested = clock()
        """Time of the last request for the stream [s]."""
        self.collected: list[Float[np.ndarray, " 6"]] | None = None
        """List to which every record is appended, in the sensor's axes [N, N m], if the caller sets
        one."""
        self.rotation = rotation(config.frame)
        self._scale = np.array(scale)
        self._sequence: int | None = None
        """Sequence number of the latest record."""
        self._missing = 0
        """Number of records lost or discarded since the last one passed to the filter."""
        self._force: tuple[float, Wrench] | None = None
        self._peak = np.zeros(6)

    @property
    def delay_s(self) -> float:
        """Filter delay [s]."""
        return self.filter.delay / self.times.rate_hz

    def request(self) -> None:
        """Request a stream; its first record comes next."""
        self.client.send(RdtCommand.START)
        self.requested = self._clock()
        self._begin()

    def take(self) -> None:
        """Process the records that have arrived."""
        arrivals = self.client.drain()
        if not arrivals:
            return
        self.taken = self._clock()
        self.status = 0
        # The filter is as long as twice its delay.
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
        """Return the latest force, which does not change during a gap; None before the first."""
        output = self.filter.output()
        if output is not None:
            moment = self.times.estimate_time(self.filter.newest) - self.delay_s
            # The measured rate is still settling, but reported times must not go backwards.
            latest = moment if self._force is None else max(moment, self._force[0])
            self._force = (latest, rotated(output, self.rotation))
        if self._force is None:
            return None
        # The rotation only permutes axes and flips signs, so the magnitudes can be rotated with its
        # absolute value.
        peak = rotated(self._peak, np.abs(self.rotation))
        self._peak = np.zeros(6)
        return ForceReading(*self._force, peak)

    def _begin(self) -> None:
        """Start over: the next record must not be joined to earlier ones."""
        self._sequence = None
        self._missing = 0
        self.filter.clear()
        self.times.restart()

    def _advance(self, record: RdtRecord, time: float) -> bool:
        """Count a record; return False if it is not newer than those before."""
        step = 1 if self._sequence is None else wrapped_step(self._sequence, record.rdt_sequence)
        if not -LATE_RECORDS <= step <= MAX_GAP:
            # The sensor started another stream. If the jump were treated as a gap, the measured
            # rate would be in the billions.
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
            # The gap may not correspond to elapsed time, if the sensor's sequence numbers jumped.
            self.times.restart()
        values = self._scale * record.counts
        self.filter.put(values, self._missing)
        self._missing = 0
        np.maximum(self._peak, np.abs(values), out=self._peak)
        if self.collected is not None:
            self.collected.append(values)
