"""Client for the record stream of an Axia80 over UDP, which also provides the arrival time of each
record."""

import contextlib
import socket
import struct
import sys
from typing import NamedTuple

from softfin.core.errors import DeviceError
from softfin.rig.computer import Computer
from softfin.rig.devices.axia80.rdt import (
    RdtCommand,
    RdtRecord,
    decode_record,
    encode_request,
)

BUFFER_BYTES = 4 * 1024 * 1024
"""Requested size of the kernel's receive buffer [bytes]: several seconds of the stream, in case the
process is delayed. Linux grants at most twice `net.core.rmem_max`, 0.5 s of the stream by
default."""

MAX_DATAGRAMS = 1000
"""Maximum number of datagrams per call to `drain`. After a pause, 5,000 or more may be waiting;
processing all of them would take several ticks and exceed the overrun limit of the loop. At 8 kHz,
80 arrive per tick, so a backlog still shrinks."""

UNREAD_S = 0.03
"""Maximum time since the socket was empty for which a record without a usable timestamp is treated
as new [s]."""

DATE_STEP_S = 0.005
"""Change in the offset between wall clock and monotonic clock between two drains above which
softfin assumes that the wall clock was set [s]. NTP slews the wall clock by at most 0.5 ms/s."""

OFFSET_TRIES = 10
"""Number of attempts to read the wall clock and the monotonic clock without a delay in between."""

# Linux socket option that Python's socket module does not define. The number is the same on x86 and
# ARM.
SO_TIMESTAMPNS = 35
STAMP = struct.Struct("@ll")
"""Kernel timestamp: seconds and nanoseconds of the wall clock."""


class Arrival(NamedTuple):
    """A record and its monotonic arrival time at this computer [s]."""

    record: RdtRecord
    time: float


class RdtClient:
    """Non-blocking UDP client. The socket is connected so that the kernel delivers only datagrams
    from the port of the sensor."""

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
            # keeps the oldest records and drops new ones. If records were timestamped when they are
            # read, a force from a minute ago would seem current, and the motor would be powered
            # based on this force. Therefore, use the time at which the kernel received each record.
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
        """Return the received records, oldest first, from at most MAX_DATAGRAMS datagrams."""
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
                # An ICMP error means that an earlier request found no listener. `StreamedSensor`
                # reports the missing records.
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
        # A record without a timestamp is treated as new only if the socket was empty a moment ago;
        # otherwise, assume the maximum possible age.
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

        On a busy computer, the process may be interrupted between the two readings, which would
        seem like a change of the wall clock. The readings are therefore repeated until they are
        close together.
        """
        for _ in range(OFFSET_TRIES):
            before = self._clock()
            date = self._clock.wall()
            after = self._clock()
            if after - before < DATE_STEP_S / 10:
                break
        # If no pair is close together, subtracting the earlier reading makes records seem older
        # than they are, but never newer.
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
