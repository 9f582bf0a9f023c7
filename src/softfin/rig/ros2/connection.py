"""Interface for the transport to other nodes, implemented by rclpy and DDS, and subscriptions that
read topics as timestamped values.

Messages are sent and received as CDR. Unusable messages are counted and reported once. Timestamps
from other computers are mapped to our monotonic clock using the smallest delay so far, as in the
clock filter of NTP; this minimum is relaxed slowly to follow a drifting clock.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import (
    Any,
    Generic,
    Literal,
    Protocol,
    SupportsFloat,
    TypeAlias,
    TypeVar,
    runtime_checkable,
)

from softfin.core.errors import one_line
from softfin.rig.machine import Wrench
from softfin.rig.stream_clock import ShortestDelay
from softfin.storage.bag.messages import SECOND_NS, type_store

Value = TypeVar("Value")

BOOL = "std_msgs/msg/Bool"

DEPTH = 10
"""Default length of a reader queue, which keeps the latest messages; same as in ROS 2."""

CREEP = 2e-4
"""Rate at which the smallest delay is relaxed [s/s]: four times the drift of an ordinary quartz
clock (50 ppm)."""


Take: TypeAlias = Callable[[], list[tuple[bytes, float]]]
"""Function that returns the messages received since the last call, oldest first, as CDR with the
reception time from `time.monotonic` [s].

The function never waits, and raises DeviceError if no messages can be received.
"""


Quality: TypeAlias = Literal["reliable", "best_effort", "latched"]
"""Quality of service requested by a reader, which determines which publishers match.

reliable: reliable publishers; lost messages are sent again. best_effort: all publishers; lost
messages are not sent again. latched: publishers that keep messages for late readers (transient
local), including earlier messages.
"""


@dataclass
class Subscriber:
    """A topic that softfin reads."""

    take: Take
    """Function that returns the received messages."""
    mismatched: Callable[[], int]
    """Function that returns the number of publishers so far whose messages are not received because
    they offer a lower quality of service than requested."""
    publishers: Callable[[], list[str]]
    """Function that returns the names of the current publishers whose messages are received, in no
    particular order."""


@dataclass
class Publisher:
    """A topic to which softfin writes."""

    send: Callable[[bytes], None]
    """Function that sends one message as CDR; raises DeviceError if the message cannot be sent
    immediately."""
    readers: Callable[[], int]
    """Function that returns the number of current subscribers."""


@runtime_checkable
class Transport(Protocol):
    """Transport to other nodes."""

    notes: tuple[str, ...]
    """Notes for the user on the connection, one line each."""

    def publish(
        self, topic: str, kind: str, deadline_s: float | None = None, latched: bool = False
    ) -> Publisher:
        """Create a publisher with the settings reliable, keep last 10 and volatile.

        If it is `latched`, it keeps only its last message, also for later readers that request a
        latched quality (transient local).

        With `deadline_s`, the publisher offers this deadline and manual-by-topic liveliness with
        the same lease [s]. The middleware of a reader can then report missing messages. Readers
        that request neither still match.
        """

    def subscribe(
        self, topic: str, kind: str, quality: Quality = "reliable", depth: int = DEPTH
    ) -> Subscriber:
        """Create a subscriber that keeps the last `depth` messages."""

    def topics(self) -> dict[str, str]:
        """Return the topics published by other nodes, with their types."""

    def publishers(self, topic: str) -> list[str]:
        """Return the sorted names of other nodes that publish on a topic."""

    def close(self) -> None:
        """Close the connection; may be called repeatedly and never raises."""


class StampClock:
    """Mapping from the timestamps of one sender to our clock; the result is never later than the
    arrival of the message."""

    def __init__(self) -> None:
        self._first = self._newest = 0
        self._shortest = ShortestDelay(CREEP)

    def time(self, stamp_ns: int, received: float) -> float | None:
        """Return the time on our clock [s]; None if the timestamp is not later than the previous
        one."""
        if not stamp_ns:
            return received
        if not self._first:
            self._first = stamp_ns
        elif stamp_ns <= self._newest:
            return None
        self._newest = stamp_ns
        since = (stamp_ns - self._first) / SECOND_NS
        return since + self._shortest.update(since, received)


class Subscription(Generic[Value]):
    """Subscription to one topic; `read` extracts the value from a message or raises ValueError with
    the reason."""

    def __init__(
        self,
        transport: Transport,
        topic: str,
        kind: str,
        read: Callable[[Any], Value],
        stamped: bool = True,
        quality: Quality = "reliable",
        depth: int = DEPTH,
    ) -> None:
        """Subscribe. If messages are not `stamped`, the arrival time is used instead of the time in
        the header; `depth` is the length of the queue between two calls of `take`."""
        self.topic = topic
        self.kind = kind
        self._read = read
        self._stamped = stamped
        self._subscriber = transport.subscribe(topic, kind, quality, depth)
        self._transport = transport
        self._clock = StampClock()
        self.received = self.refused = self.not_newer = 0
        self.refusal: str | None = None
        """Reason why the latest message was rejected; None if it was accepted."""

    def take(self) -> list[tuple[float, Value]]:
        """Return the values received since the last call, oldest first, each with its time on our
        clock [s]."""
        taken = []
        for data, received in self._subscriber.take():
            self.received += 1
            try:
                message = decode_ros_message(data, self.kind)
                value = self._read(message)
            except (ValueError, OverflowError) as error:
                self.refused += 1
                self.refusal = f"{self.topic}: message rejected: {error}; correct its publisher"
                continue
            self.refusal = None
            time = self._clock.time(read_stamp(message) if self._stamped else 0, received)
            if time is None:
                self.not_newer += 1
            else:
                taken.append((time, value))
        return taken

    def mismatched(self) -> int:
        """Return the number of publishers so far whose quality of service is lower than
        requested."""
        return self._subscriber.mismatched()

    def explain_publishers(self) -> str | None:
        """Explain why the publishers of the topic cannot be used, ending with the fix; None if
        there is exactly one publisher."""
        publishers = sorted(self._subscriber.publishers())
        if not publishers:
            return f"{self.topic}: no longer has a publisher; restart its driver"
        if len(publishers) > 1:
            names = ", ".join(publishers)
            return f"{self.topic}: has {len(publishers)} publishers ({names}); stop all but one"
        return None

    def explain_silence(self, waited_s: float) -> str:
        """Explain why there has been no usable value for `waited_s` [s], ending with the fix."""
        there = [f"{topic} ({kind})" for topic, kind in self._transport.topics().items()]
        return self.refusal or (
            f"{self.topic}: no {self.kind} within {waited_s:g} s; found "
            f"{', '.join(there[:20]) or 'nothing'}; start its driver, or correct the topic, the "
            "domain (ROS_DOMAIN_ID) or the network"
        )


def decode_ros_message(data: bytes, kind: str) -> Any:
    """Decode a message of a standard ROS 2 type from CDR; raises ValueError if the bytes are
    invalid."""
    try:
        return type_store().deserialize_cdr(data, kind)
    except Exception as error:
        # Arbitrary bytes may fail at any step of the decoder.
        raise ValueError(f"{len(data)} bytes are not a valid {kind} ({one_line(error)})") from None


def read_stamp(message: object) -> int:
    """Return the timestamp in the message header [ns since 1970], or 0 if it has none."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * SECOND_NS + int(header.stamp.nanosec)


def read_joint(message: Any, name: str) -> tuple[float, float | None]:
    """Return the angle and velocity of the joint `name`; the velocity is None if missing from the
    message."""
    names = list(message.name)
    if name not in names:
        raise ValueError(
            f"no joint {name!r}; its joints are {', '.join(map(repr, names[:10])) or 'none'}"
        )
    index = names.index(name)
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        raise ValueError(
            f"{len(names)} names, {len(message.position)} positions, {len(message.velocity)} "
            "velocities; send the same number of each, or no velocities"
        )
    angle = _finite("position", message.position[index])
    return angle, _finite("velocity", message.velocity[index]) if len(message.velocity) else None


def read_wrench(message: Any) -> Wrench:
    """Return force and torque in the axes of the message [N, N m]."""
    parts = (("force", message.wrench.force), ("torque", message.wrench.torque))
    fx, fy, fz, tx, ty, tz = (
        _finite(f"{name} {axis}", getattr(part, axis)) for name, part in parts for axis in "xyz"
    )
    return fx, fy, fz, tx, ty, tz


def read_reference_message(message: Any, frame: str) -> tuple[float, float]:
    """Return the reference force in a WrenchStamped, whose frame must be ours or empty."""
    check_frame(message, frame)
    force = message.wrench.force
    return _finite("x", force.x), _finite("y", force.y)


def check_frame(message: Any, frame: str) -> None:
    """Raise ValueError if a message is in a different frame; an empty frame means ours, as does the
    name of our frame without the prefix of a fin."""
    theirs = message.header.frame_id
    if theirs not in ("", frame, frame.rpartition("/")[2]):
        raise ValueError(f"its frame is {theirs!r}, expected {frame!r}")


def _finite(name: str, value: SupportsFloat) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"its {name} is {number}, not finite")
    return number
