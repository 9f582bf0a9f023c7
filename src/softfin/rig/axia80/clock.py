"""When a record was taken: the monotonic time of its place in the stream, whatever network and wall clock do."""

import socket
import struct
import sys
from collections import deque
from collections.abc import Sequence

# Linux' own numbers, which Python's socket module does not name; the same on x86 and ARM.
SO_TIMESTAMPNS = 35
STAMP = struct.Struct("@ll")

KEPT = 12
"""Stamps that the earliest is sought in; a tenth of a second at 100 Hz. A packet that was held up moves no time."""

PAUSE_S = 0.2
"""A stream that was silent for longer: what was stamped before says little of what comes now."""

BASE_S = 0.3
"""Shortest stretch of a stream that tells its rate."""


def stamps_asked(receiver: socket.socket) -> bool:
    """Ask the kernel to stamp what arrives; False where it does not do that."""
    if not sys.platform.startswith("linux") or not hasattr(receiver, "recvmsg"):
        return False
    try:
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError:
        return False
    return True


def wall_stamp(ancillary: Sequence[tuple[int, int, bytes]]) -> float | None:
    """The wall clock's time [s] at which the kernel received it, where it said so."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(data) >= STAMP.size:
            seconds, nanoseconds = STAMP.unpack_from(data)
            return float(seconds + nanoseconds * 1e-9)
    return None


class StreamClock:
    """Places of records against their stamps: an even stream, of which no record can be stamped too early."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        """As measured, once the stream has lasted; until then the one that was told."""
        self._stamps: deque[tuple[int, float]] = deque(maxlen=KEPT)
        self._base: tuple[int, float] | None = None

    def begin(self) -> None:
        """Another stream; its rate is taken to be the old one's until it is measured."""
        self._stamps.clear()
        self._base = None

    def stamp(self, place: int, time: float) -> None:
        """A record that was received then."""
        if self._base is None:
            self._base = (place, time)
        first, began = self._base
        if time - began >= BASE_S and place > first:
            self.rate_hz = (place - first) / (time - began)
        if self._stamps and time - self._stamps[-1][1] > PAUSE_S:
            self._stamps.clear()
        self._stamps.append((place, time))

    @property
    def measured_s(self) -> float:
        """How long the stream has lasted [s]."""
        return self._stamps[-1][1] - self._base[1] if self._base and self._stamps else 0.0

    def time_of(self, place: float | int) -> float:
        """The monotonic time [s] of a place near the newest ones."""
        return min(time + (place - stamped) / self.rate_hz for stamped, time in self._stamps)
