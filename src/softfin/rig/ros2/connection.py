"""Open a transport, and read topics through it: bytes in, checked values with their times out.

Unusable messages are counted and reported once. The stamps of other computers become times of our monotonic clock by
the smallest delay so far, as in NTP's clock filter, released slowly so that a clock that drifts is followed.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from softfin.core.errors import RigError
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.messages import Messages, stamp_of
from softfin.rig.ros2.transport import Transport

Value = TypeVar("Value")

CREEP = 2e-4
"""Rate at which the smallest delay is released [s/s]: four times the drift of a common quartz, 50 ppm."""


def open_transport(config: TransportConfig, messages: Messages) -> Transport:
    """rclpy where it is installed, else DDS, or as configured; raises RigError where that is not installed."""
    installed = importlib.util.find_spec("rclpy") is not None
    if config.transport == "rclpy" and not installed:
        raise RigError("rclpy is not installed in this Python; source ROS 2's setup file, or use transport: dds")
    if config.transport == "rclpy" or (config.transport == "auto" and installed):
        from softfin.rig.ros2.rclpy import RclpyTransport

        return RclpyTransport(config)
    from softfin.rig.ros2.dds import DdsTransport

    return DdsTransport(config, messages)


class StampClock:
    """Maps stamps of one sender to our clock; never to later than the message came."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._newest = 0
        self._offset = self._received = 0.0

    def time(self, stamp_ns: int, received: float) -> float | None:
        """Time of our clock [s]; None where the stamp is not later than the one before."""
        if stamp_ns == 0:
            return received
        if self._first is None:
            self._first, self._offset, self._received = stamp_ns, received, received
        elif stamp_ns <= self._newest:
            return None
        self._newest = stamp_ns
        since = (stamp_ns - self._first) / 1e9
        released = self._offset + CREEP * (received - self._received)
        self._offset, self._received = min(released, received - since), received
        return since + self._offset


@dataclass(frozen=True)
class Stamped(Generic[Value]):
    """The value of one message."""

    time: float
    """When it was measured, of our clock [s]."""
    received: float
    value: Value


class Subscription(Generic[Value]):
    """One topic that is read."""

    def __init__(
        self, transport: Transport, messages: Messages, topic: str, kind: str, value: Callable[[Any], Value],
        stamped: bool = True, best_effort: bool = False,
    ) -> None:  # fmt: skip
        """Messages that are not `stamped` count from when they come, whatever is in their header."""
        self.topic, self.kind = topic, kind
        self._messages, self._value, self._stamped = messages, value, stamped
        self._take = transport.subscribe(topic, kind, best_effort)
        self._clock = StampClock()
        self.received = self.refused = self.not_newer = 0
        self.refusal: str | None = None
        """Why the last message was refused; None where it was not."""

    def take(self) -> list[Stamped[Value]]:
        """The usable messages that have come since the last call, oldest first."""
        taken = []
        for data, received in self._take():
            self.received += 1
            try:
                message = self._messages.decode(data, self.kind)
                value = self._value(message)
            except (ValueError, OverflowError) as error:
                self.refused += 1
                self.refusal = f"{self.topic}: refused: {error}; correct its publisher"
                continue
            self.refusal = None
            time = self._clock.time(stamp_of(message) if self._stamped else 0, received)
            if time is None:
                self.not_newer += 1
            else:
                taken.append(Stamped(time, received, value))
        return taken
