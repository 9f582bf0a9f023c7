"""What softfin's bags hold: topics, their messages as CDR, and definitions by which any reader decodes them.

Times are nanoseconds since 1970. Names of types are full, as ``sensor_msgs/msg/JointState``: readers refuse others.
"""

import importlib.metadata
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

COMMAND, JOINT, WRENCH = "/fin/command", "/fin/joint_states", "/fin/wrench"
REFERENCE, CURRENT, EVENTS = "/fin/reference", "/fin/current", "/fin/events"

DEFAULT_TOPICS = {"command": COMMAND, "joint": JOINT, "wrench": WRENCH}
"""Topics that become a log, by the role that `softfin.data.importing` gives them."""

JOINT_STATE, WRENCH_STAMPED = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"

TYPES = {
    COMMAND: JOINT_STATE,
    JOINT: JOINT_STATE,
    WRENCH: WRENCH_STAMPED,
    REFERENCE: WRENCH_STAMPED,
    CURRENT: "std_msgs/msg/Float64",
    EVENTS: "std_msgs/msg/String",
}

QUALITY = {"offered_qos_profiles": ""}
"""Entry that MCAP's profile for ROS 2 requires; empty is ROS 2's default quality of service."""

FRAME = "fin"
"""Frame of the force and name of the joint."""

SECOND_NS = 1_000_000_000

CHUNK_BYTES = 1024 * 1024
"""Length at which a chunk ends unless it was flushed before."""


class Row(NamedTuple):
    """One message before it is serialised."""

    topic: str
    stamp_ns: int
    """Time since 1970 [ns]."""
    values: tuple[float, ...] | str
    """Angle and velocity [rad, rad/s] of a joint or command; force and torque [N, N m]; a current [A]; a text."""


@cache
def type_store() -> Typestore:
    """ROS 2's own definitions of messages, which serialise and deserialise CDR."""
    return get_typestore(Stores.ROS2_HUMBLE)


def cdr(row: Row) -> bytes:
    """The bytes of a message, in OMG's CDR as ROS 2 uses it."""
    store, kind, values = type_store(), TYPES[row.topic], row.values
    make: Any = store.types
    message: Any
    if isinstance(values, str):
        message = make[kind](values.encode(errors="replace").decode())
    elif kind == TYPES[CURRENT]:
        message = make[kind](*values)
    else:
        time = make["builtin_interfaces/msg/Time"](*divmod(row.stamp_ns, SECOND_NS))
        header = make["std_msgs/msg/Header"](time, FRAME)
        if kind == JOINT_STATE:
            angle, velocity = (np.array([value], np.float64) for value in values)
            message = make[kind](header, [FRAME], angle, velocity, np.zeros(0))
        else:
            vector, (*force, x, y, z) = make["geometry_msgs/msg/Vector3"], values
            wrench = make["geometry_msgs/msg/Wrench"](vector(*force), vector(x, y, z))
            message = make[kind](header, wrench)
    return bytes(store.serialize_cdr(message, kind))


class BagWriter:
    """An MCAP file that is written to a stream, row by row.

    Chunks are not compressed: of one that a power cut left half-written every whole message can be read.
    """

    def __init__(self, stream: Any) -> None:
        self._writer = start_writer(stream)
        store = type_store()
        schemas = {
            kind: self._writer.register_schema(kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode())
            for kind in dict.fromkeys(TYPES.values())
        }
        self._channels = {
            topic: self._writer.register_channel(topic, "cdr", schemas[kind], QUALITY) for topic, kind in TYPES.items()
        }
        self.written = dict.fromkeys(TYPES, 0)
        """Number of messages by topic."""

    def write(self, row: Row) -> None:
        """Add a message to the chunk."""
        stamp, sequence = row.stamp_ns, self.written[row.topic]
        self._writer.add_message(self._channels[row.topic], stamp, cdr(row), stamp, sequence)
        self.written[row.topic] += 1

    def flush(self) -> None:
        """End the chunk."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the index and the end."""
        self._writer.finish()


def start_writer(stream: Any) -> Any:
    """Start an MCAP file as all of softfin's are written."""
    writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
    writer.start(profile="ros2", library=f"softfin {importlib.metadata.version('softfin')}")
    return writer
