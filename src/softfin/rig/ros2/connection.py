"""The contract of a way to other nodes, which rclpy and DDS meet alike, and topics read through it:
values with times.

Messages go out and come in as CDR. Unusable ones are counted and reported once. The stamps of other
computers become times of our monotonic clock by the smallest delay so far, as in NTP's clock
filter, released slowly so that a clock that drifts is followed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeAlias, TypeVar, runtime_checkable

from softfin.core.errors import one_line
from softfin.rig.machine import Wrench
from softfin.storage.bag.messages import SECOND_NS, type_store

Value = TypeVar("Value")

VECTOR = "geometry_msgs/msg/Vector3Stamped"
BOOL = "std_msgs/msg/Bool"

DEPTH = 10
"""Messages that are kept for a reader that is slower: ROS 2's default."""

CREEP = 2e-4
"""Rate at which the smallest delay is released [s/s]: four times the drift of a common quartz, 50
ppm."""


Take: TypeAlias = Callable[[], list[tuple[bytes, float]]]
"""Returns what has come since the last call, oldest first: CDR, and when it was taken, of
`time.monotonic` [s].

It never waits, and raises DeviceError where nothing can come.
"""


Quality: TypeAlias = Literal["reliable", "best_effort", "latched"]
"""Quality of service that a reader asks for; each hears other publishers.

reliable: those that are reliable; what is lost is sent again. best_effort: all, but nothing is sent
again. latched: those that keep messages for late readers (transient local), with the ones from
before.
"""


@dataclass
class Subscriber:
    """A topic that we read."""

    take: Take
    """Takes what has come."""
    mismatched: Callable[[], int]
    """Number of publishers met so far that it does not hear, because they offer less than it asks
    for."""


@dataclass
class Publisher:
    """A topic that we write to."""

    send: Callable[[bytes], None]
    """Sends one message as CDR; raises DeviceError where it cannot go out at once."""
    readers: Callable[[], int]
    """Number of nodes that read it now."""


@runtime_checkable
class Transport(Protocol):
    """The way to other nodes."""

    notes: tuple[str, ...]
    """Remarks for the user about how it was opened, each one line."""

    def publish(self, topic: str, kind: str, deadline_s: float | None = None) -> Publisher:
        """A topic to write to: reliable, keep last 10, volatile.

        With `deadline_s`, it offers that deadline, and liveliness by topic with that lease: then a
        reader may ask its middleware to report when no message came for so long [s]. Readers that
        ask for neither match all the same.
        """

    def subscribe(self, topic: str, kind: str, quality: Quality = "reliable") -> Subscriber:
        """A topic to read, keep last 10."""

    def topics(self) -> dict[str, str]:
        """Topics that other nodes publish, each with its type."""

    def close(self) -> None:
        """Leave; any number of times, never raises."""


class StampClock:
    """Maps stamps of one sender to our clock; never to later than the message came."""

    def __init__(self) -> None:
        self._first = self._newest = 0
        self._offset = self._received = 0.0

    def time(self, stamp_ns: int, received: float) -> float | None:
        """Time of our clock [s]; None where the stamp is not later than the one before."""
        if not stamp_ns:
            return received
        if not self._first:
            self._first = stamp_ns
            self._offset = received
            self._received = received
        elif stamp_ns <= self._newest:
            return None
        self._newest = stamp_ns
        since = (stamp_ns - self._first) / SECOND_NS
        released = self._offset + CREEP * (received - self._received)
        self._offset = min(released, received - since)
        self._received = received
        return since + self._offset


class Subscription(Generic[Value]):
    """One topic that is read; `read` takes the value from a message, and raises ValueError with the
    reason."""

    def __init__(
        self,
        transport: Transport,
        topic: str,
        kind: str,
        read: Callable[[Any], Value],
        stamped: bool = True,
        quality: Quality = "reliable",
    ) -> None:
        """Messages that are not `stamped` count from when they come, whatever is in their
        header."""
        self.topic = topic
        self.kind = kind
        self._read = read
        self._stamped = stamped
        self._subscriber = transport.subscribe(topic, kind, quality)
        self._clock = StampClock()
        self.received = self.refused = self.not_newer = 0
        self.refusal: str | None = None
        """Reason why the last message was refused; None where it was not."""

    def take(self) -> list[tuple[float, Value]]:
        """The usable messages that have come since the last call, oldest first, each with its time
        of our clock [s]."""
        taken = []
        for data, received in self._subscriber.take():
            self.received += 1
            try:
                message = decode_ros_message(data, self.kind)
                value = self._read(message)
            except (ValueError, OverflowError) as error:
                self.refused += 1
                self.refusal = f"{self.topic}: refused: {error}; correct its publisher"
                continue
            self.refusal = None
            time = self._clock.time(read_stamp(message) if self._stamped else 0, received)
            if time is None:
                self.not_newer += 1
            else:
                taken.append((time, value))
        return taken

    def mismatched(self) -> int:
        """Number of publishers met so far that cannot be heard, because they offer less than is
        asked for."""
        return self._subscriber.mismatched()


def decode_ros_message(data: bytes, kind: str) -> Any:
    """A message of ROS 2's own types from CDR; raises ValueError where the bytes are not such a
    message."""
    try:
        return type_store().deserialize_cdr(data, kind)
    except Exception as error:
        # Bytes that anybody sent fail at any step of the decoder.
        raise ValueError(
            f"{len(data)} bytes that are not a valid {kind} ({one_line(error)})"
        ) from None


def read_stamp(message: object) -> int:
    """Time since 1970 in its header [ns]; 0 where there is none."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * SECOND_NS + int(header.stamp.nanosec)


def read_joint(message: Any, name: str) -> tuple[float, float | None]:
    """Angle and velocity of the joint of that name; the velocity None where the message has
    none."""
    names = list(message.name)
    if name not in names:
        raise ValueError(
            f"no joint {name!r} in it; it has {', '.join(map(repr, names[:10])) or 'none'}"
        )
    index = names.index(name)
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        raise ValueError(
            f"{len(names)} names, {len(message.position)} positions, {len(message.velocity)} "
            "velocities; send as many of each, or no velocities"
        )
    angle = _finite("position", message.position[index])
    return angle, _finite("velocity", message.velocity[index]) if len(message.velocity) else None


def read_wrench(message: Any) -> Wrench:
    """Force and torque in the message's own axes."""
    parts = (("force", message.wrench.force), ("torque", message.wrench.torque))
    fx, fy, fz, tx, ty, tz = (
        _finite(f"{name} {axis}", getattr(part, axis)) for name, part in parts for axis in "xyz"
    )
    return fx, fy, fz, tx, ty, tz


def read_reference_message(message: Any, frame: str) -> tuple[float, float]:
    """The reference force of a WrenchStamped or a Vector3Stamped in our frame, or without one."""
    check_frame(message, frame)
    vector = message.wrench.force if hasattr(message, "wrench") else message.vector
    return _finite("x", vector.x), _finite("y", vector.y)


def check_frame(message: Any, frame: str) -> None:
    """Raise ValueError where a message is in another frame than ours; an empty one is ours."""
    theirs = message.header.frame_id
    if theirs not in ("", frame):
        raise ValueError(f"it is in the frame {theirs!r}; this node's is {frame!r}")


def _finite(name: str, value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"its {name} is {number}")
    return number
