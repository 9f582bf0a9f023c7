"""What softfin's bags hold: the topics, their messages as CDR, and the definitions that let any reader decode them.

Times are nanoseconds since 1970. Names of types are full, as ``sensor_msgs/msg/JointState``: readers refuse others.
"""

import struct
from functools import cache
from typing import Any, NamedTuple

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from softfin.storage.bag.topics import DEFAULT_TOPICS

COMMAND, JOINT, WRENCH = DEFAULT_TOPICS["command"], DEFAULT_TOPICS["joint"], DEFAULT_TOPICS["wrench"]
REFERENCE, CURRENT, EVENTS = "/fin/reference", "/fin/current", "/fin/events"

TYPES = {
    COMMAND: "sensor_msgs/msg/JointState",
    JOINT: "sensor_msgs/msg/JointState",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    REFERENCE: "geometry_msgs/msg/WrenchStamped",
    CURRENT: "std_msgs/msg/Float64",
    EVENTS: "std_msgs/msg/String",
}

QUALITY = {"offered_qos_profiles": ""}
"""MCAP's profile for ROS 2 wants it there; empty is ROS 2's default quality of service."""

FRAME = "fin"
"""Frame of the force and name of the joint."""

SECOND_NS = 1_000_000_000


class Row(NamedTuple):
    """One message before it is serialised."""

    topic: str
    stamp_ns: int
    """Since 1970."""
    values: tuple[float, ...] | str
    """Of a joint or command angle and velocity [rad, rad/s]; force and torque [N, N m]; a current [A]; a text."""


_CDR = b"\0\1\0\0"
"""What precedes a message: little-endian CDR."""

_TEXT = struct.Struct("<4sI")
_NUMBER = struct.Struct("<4sd")
_HEADER = "4sIII4s"
"""CDR's own, stamp, length of the frame's name, the name with its zero."""
_WRENCH = struct.Struct(f"<{_HEADER}6d")
_JOINT = struct.Struct(f"<{_HEADER}II4sIdI4xdI")
"""One name, one angle, one velocity, no effort; doubles stand at multiples of eight, counted behind the first four."""

_NAME = FRAME.encode() + b"\0"


@cache
def type_store() -> Typestore:
    """ROS 2's own definitions of messages, which serialise and deserialise CDR."""
    return get_typestore(Stores.ROS2_HUMBLE)


def cdr(row: Row) -> bytes:
    """The bytes of a message, in OMG's CDR as ROS 2 uses it.

    Packed at once: general serialisers take several times as long, and the loop waits for Python meanwhile.
    """
    kind, values = TYPES[row.topic], row.values
    if isinstance(values, str):
        text = values.encode(errors="replace") + b"\0"
        return _TEXT.pack(_CDR, len(text)) + text
    if kind == TYPES[CURRENT]:
        return _NUMBER.pack(_CDR, *values)
    head = (_CDR, *divmod(row.stamp_ns, SECOND_NS), len(_NAME), _NAME)
    if kind == TYPES[JOINT]:
        angle, velocity = values
        return _JOINT.pack(*head, 1, len(_NAME), _NAME, 1, angle, 1, velocity, 0)
    return _WRENCH.pack(*head, *values)


def definitions() -> dict[str, bytes]:
    """Of each type and of all that it is made of, as ROS 2's .msg files are joined."""
    store = type_store()
    return {kind: store.generate_msgdef(kind, ros_version=2)[0].encode() for kind in dict.fromkeys(TYPES.values())}


class BagWriter:
    """Rows in, MCAP on a stream out.

    Chunks are not compressed: of one that a cut of power left half-written every whole message can be read.
    """

    def __init__(self, stream: Any, library: str) -> None:
        self._writer = writer_on(stream, library)
        schemas = {kind: self._writer.register_schema(kind, "ros2msg", text) for kind, text in definitions().items()}
        self._channels = {
            topic: self._writer.register_channel(topic, "cdr", schemas[kind], QUALITY) for topic, kind in TYPES.items()
        }
        self.written = dict.fromkeys(TYPES, 0)
        """Messages by topic."""

    def write(self, row: Row) -> None:
        """Add to the chunk."""
        stamp, sequence = row.stamp_ns, self.written[row.topic]
        self._writer.add_message(self._channels[row.topic], stamp, cdr(row), stamp, sequence)
        self.written[row.topic] += 1

    def flush(self) -> None:
        """End the chunk."""
        self._writer.flush()

    def finish(self) -> None:
        """The index and the end."""
        self._writer.finish()


def writer_on(stream: Any, library: str) -> Any:
    """As all of softfin's bags are written; a chunk ends with `flush`, or at `CHUNK_BYTES`."""
    writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
    writer.start(profile="ros2", library=library)
    return writer


CHUNK_BYTES = 1024 * 1024
"""No chunk is longer by more than one message."""
