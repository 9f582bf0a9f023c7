"""ROS 2 topics in simulated time: publishers and subscribers with the same clock exchange messages
immediately and in order, within one process."""

import itertools
from collections import deque

from softfin.emulation.time import SimulatedTime
from softfin.rig.ros2.connection import DEPTH, Publisher, Quality, Subscriber

_numbers = itertools.count(1)


class SimulatedTransport:
    """Transport within one process. Every subscriber receives from every publisher of its type,
    whatever the quality of service."""

    notes: tuple[str, ...] = ()

    def __init__(self, clock: SimulatedTime) -> None:
        self._clock = clock
        self._name = f"node {next(_numbers)}"
        self._all: list[SimulatedTransport] = clock.shared.setdefault("ROS 2", [])
        self._all.append(self)
        self._published: list[tuple[str, str]] = []
        """Topics and types of the publishers."""
        self._queues: list[tuple[tuple[str, str], deque[tuple[bytes, float]]]] = []
        """Topics and types of the subscribers, with the messages that they have not taken."""

    def publish(
        self, topic: str, kind: str, deadline_s: float | None = None, latched: bool = False
    ) -> Publisher:
        """Create a publisher; `deadline_s` has no effect."""
        channel = (topic, kind)
        self._published.append(channel)

        def queues() -> list[deque[tuple[bytes, float]]]:
            every = [pair for transport in self._all for pair in transport._queues]
            return [queue for other, queue in every if other == channel and self in self._all]

        def send(data: bytes) -> None:
            for queue in queues():
                queue.append((data, self._clock()))

        return Publisher(send, lambda: len(queues()))

    def subscribe(
        self, topic: str, kind: str, quality: Quality = "reliable", depth: int = DEPTH
    ) -> Subscriber:
        """Create a subscriber; `quality` has no effect."""
        channel = (topic, kind)
        queue: deque[tuple[bytes, float]] = deque(maxlen=depth)
        self._queues.append((channel, queue))

        def take() -> list[tuple[bytes, float]]:
            return [queue.popleft() for _ in range(len(queue))]

        def publishers() -> list[str]:
            return [
                transport._name
                for transport in self._all
                for published in transport._published
                if published == channel
            ]

        return Subscriber(take, lambda: 0, publishers)

    def topics(self) -> dict[str, str]:
        """Return the topics published by other nodes, with their types."""
        others = [transport for transport in self._all if transport is not self]
        return dict(sorted(channel for transport in others for channel in transport._published))

    def publishers(self, topic: str) -> list[str]:
        """Return the sorted names of the other nodes' publishers on a topic."""
        return sorted(
            transport._name
            for transport in self._all
            for published, _ in transport._published
            if published == topic and transport is not self
        )

    def close(self) -> None:
        """Remove all publishers and subscribers; may be called repeatedly."""
        if self in self._all:
            self._all.remove(self)
