"""What a topic tells: bytes in, checked values with their times out; what cannot be used is counted, and said once.

The stamps of other computers become times of our monotonic clock by the smallest delay that was met, as in NTP's clock
filter, let go of slowly so that a clock that drifts is followed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from softfin.rig.ros2.messages import Messages, stamp_of
from softfin.rig.ros2.transport import Inlet, Transport

Value = TypeVar("Value")

CREEP = 2e-4
"""How fast the smallest delay is let go of [s/s]: four times the drift of a common quartz, 50 ppm."""


class StampClock:
    """Maps stamps of one sender to our clock; never to later than the message came."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._newest = 0
        self._offset = 0.0
        self._received = 0.0

    def time(self, stamp_ns: int, received: float) -> float | None:
        """Of our clock [s]; None where the stamp is no later than the one before."""
        if stamp_ns == 0:
            return received
        if self._first is None:
            self._first, self._offset, self._received = stamp_ns, received, received
        elif stamp_ns <= self._newest:
            return None
        self._newest = stamp_ns
        since = (stamp_ns - self._first) / 1e9
        let_go = self._offset + CREEP * (received - self._received)
        self._offset, self._received = min(let_go, received - since), received
        return since + self._offset


@dataclass(frozen=True)
class Told(Generic[Value]):
    """One message that can be used."""

    time: float
    """What it stands for, of our clock [s]."""
    received: float
    value: Value


class Intake(Generic[Value]):
    """One topic that is read."""

    def __init__(
        self, transport: Transport, messages: Messages, topic: str, kind: str, value: Callable[[Any], Value],
        stamped: bool = True, best_effort: bool = False,
    ) -> None:  # fmt: skip
        """Messages that are not `stamped` count from when they come, whatever is in their header."""
        self.topic, self.kind = topic, kind
        self._messages, self._value, self._stamped = messages, value, stamped
        self._inlet: Inlet = transport.subscribe(topic, kind, best_effort)
        self._clock = StampClock()
        self.received = self.refused = self.not_newer = 0
        self.refusal: str | None = None
        """Why the last message was refused; None where it was not."""

    def take(self) -> list[Told[Value]]:
        """What has come since the last call, oldest first."""
        told = []
        for data, received in self._inlet.take():
            self.received += 1
            try:
                message = self._messages.decode(data, self.kind)
                value = self._value(message)
            except (ValueError, OverflowError) as error:
                self.refused += 1
                self.refusal = f"{self.topic}: refused: {error}; mend its publisher"
                continue
            self.refusal = None
            time = self._clock.time(stamp_of(message) if self._stamped else 0, received)
            if time is None:
                self.not_newer += 1
            else:
                told.append(Told(time, received, value))
        return told
