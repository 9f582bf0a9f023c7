"""What may go wrong between an emulated sensor and its client: datagrams lost, late, doubled, out of order."""

import heapq
import itertools
import math
import random
import threading


class Network:
    """Takes datagrams as they are sent, gives them back as they arrive; safe to change from another thread."""

    def __init__(self, seed: int = 0) -> None:
        self.dropped = self.doubled = self.swapped = 0
        self._random = random.Random(seed)
        self._lock = threading.Lock()
        self._drop = self._duplicate = self._reorder = self._delay = 0.0
        self._number = itertools.count()
        self._held: bytes | None = None
        self._waiting: list[tuple[float, int, bytes]] = []

    def drop(self, fraction: float) -> None:
        """Of the datagrams, at random."""
        with self._lock:
            self._drop = _fraction(fraction)

    def duplicate(self, fraction: float) -> None:
        """Of the datagrams arrive twice."""
        with self._lock:
            self._duplicate = _fraction(fraction)

    def reorder(self, fraction: float) -> None:
        """Of the datagrams arrive after the one behind them."""
        with self._lock:
            self._reorder = _fraction(fraction)

    def delay(self, seconds: float) -> None:
        """Every datagram arrives so much later [s]."""
        if not 0 <= seconds < math.inf:
            raise ValueError(f"delay of {seconds} s; it must be 0 or more")
        with self._lock:
            self._delay = seconds

    def send(self, datagram: bytes, now: float) -> None:
        """Into the network."""
        with self._lock:
            if self._random.random() < self._drop:
                self.dropped += 1
                return
            if self._held is None and self._random.random() < self._reorder:
                self._held = datagram
                self.swapped += 1
                return
            self._wait(datagram, now)
            if self._random.random() < self._duplicate:
                self.doubled += 1
                self._wait(datagram, now)
            if self._held is not None:
                self._wait(self._held, now)
                self._held = None

    def arrived(self, now: float) -> list[bytes]:
        """Out of the network, in the order of arrival."""
        with self._lock:
            datagrams = []
            while self._waiting and self._waiting[0][0] <= now:
                datagrams.append(heapq.heappop(self._waiting)[2])
            return datagrams

    def clear(self) -> None:
        """Nothing is on its way any more."""
        with self._lock:
            self._waiting.clear()
            self._held = None

    def _wait(self, datagram: bytes, now: float) -> None:
        heapq.heappush(self._waiting, (now + self._delay, next(self._number), datagram))


def _fraction(value: float) -> float:
    if not 0 <= value <= 1:
        raise ValueError(f"fraction of {value}; it must be from 0 to 1")
    return value
