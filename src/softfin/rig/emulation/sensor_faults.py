"""Faults of the network between an emulated sensor and its client: datagrams lost, late, doubled, out of order."""

import heapq
import itertools
import random


class FaultyNetwork:
    """Takes datagrams as they are sent, returns them as they arrive. Fractions are of the datagrams, at random."""

    def __init__(self, seed: int = 0) -> None:
        self.drop = self.duplicate = self.reorder = 0.0
        """Fractions that are lost, arrive twice, arrive after the one behind them."""
        self.delay_s = 0.0
        """Time on the way of every datagram [s]."""
        self.dropped = self.doubled = self.swapped = 0
        self._random = random.Random(seed)
        self._number = itertools.count()
        self._held: bytes | None = None
        self._waiting: list[tuple[float, int, bytes]] = []

    def send(self, datagram: bytes, now: float) -> None:
        """A datagram enters the network."""
        if self._random.random() < self.drop:
            self.dropped += 1
            return
        if self._held is None and self._random.random() < self.reorder:
            self._held = datagram
            self.swapped += 1
            return
        out = [datagram]
        if self._random.random() < self.duplicate:
            self.doubled += 1
            out.append(datagram)
        if self._held is not None:
            out.append(self._held)
            self._held = None
        for each in out:
            heapq.heappush(self._waiting, (now + self.delay_s, next(self._number), each))

    def arrived(self, now: float) -> list[bytes]:
        """Datagrams that leave the network, in the order of arrival."""
        datagrams = []
        while self._waiting and self._waiting[0][0] <= now:
            datagrams.append(heapq.heappop(self._waiting)[2])
        return datagrams

    def clear(self) -> None:
        """Forget what is on its way."""
        self._waiting.clear()
        self._held = None
