"""Faults of the network between an emulated sensor and its client: datagrams lost, late, doubled,
out of order."""

import random
from collections import deque
from collections.abc import Iterator

from softfin.emulation.axia80 import EmulatedAxia80


class FaultyNetwork:
    """Put between by `between(sensor)`; fractions are of the datagrams, at random."""

    def __init__(self) -> None:
        self.dropped = self.doubled = self.swapped = 0
        self._random = random.Random(0)
        self._held: bytes | None = None
        self._waiting: deque[bytes] = deque()
        self.disturb()

    @classmethod
    def between(cls, sensor: EmulatedAxia80) -> "FaultyNetwork":
        network = cls()
        sensor.transmit = network.transmit
        return network

    def disturb(
        self, drop: float = 0.0, duplicate: float = 0.0, reorder: float = 0.0, late: int = 0
    ) -> None:
        """From now on; `late` is how many datagrams later each one comes."""
        self.drop = drop
        self.duplicate = duplicate
        self.reorder = reorder
        self.late = late

    def transmit(self, datagram: bytes) -> Iterator[bytes]:
        if self._random.random() < self.drop:
            self.dropped += 1
            return
        if self._held is None and self._random.random() < self.reorder:
            self._held = datagram
            self.swapped += 1
            return
        self._waiting.append(datagram)
        if self._random.random() < self.duplicate:
            self.doubled += 1
            self._waiting.append(datagram)
        if self._held is not None:
            self._waiting.append(self._held)
            self._held = None
        while len(self._waiting) > self.late:
            yield self._waiting.popleft()
