"""Contents of softfin's bags: topics, messages as CDR, and the definitions that readers need to
decode them.

Times are nanoseconds since 1970. Type names are complete, such as ``sensor_msgs/msg/JointState``;
readers reject shorter names.
"""

import importlib.metadata
import struct
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.log_channels import VOLTAGE_CHANNEL
from softfin.storage.formats import FILES, IN_FILE

COMMAND = "/fin/command"
JOINT = "/fin/joint_states"
WRENCH = "/fin/wrench"
REFERENCE = "/fin/reference"
ESTIMATE = "/fin/estimate"
HALF_WIDTH = "/fin/estimate/half_width"
LEVEL = "/fin/estimate/level"
CURRENT = "/fin/current"
EVENTS = "/fin/events"

CHANNEL_TOPICS = "/fin/channels/"
"""Prefix of the topics of additional log channels; the rest of a topic is the name of the
channel."""

VOLTAGE = CHANNEL_TOPICS + VOLTAGE_CHANNEL

DEFAULT_TOPICS = {"command": COMMAND, "joint": JOINT, "wrench": WRENCH}
"""Topics that become a log, keyed by their role in `softfin.data.importing`."""

JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
FLOAT = "std_msgs/msg/Float64"
STRING = "std_msgs/msg/String"

TYPES = {
    COMMAND: JOINT_STATE,
    JOINT: JOINT_STATE,
    WRENCH: WRENCH_STAMPED,
    REFERENCE: WRENCH_STAMPED,
    ESTIMATE: WRENCH_STAMPED,
    HALF_WIDTH: WRENCH_STAMPED,
    LEVEL: FLOAT,
    CURRENT: FLOAT,
    EVENTS: STRING,
}

FIELDS = {
    JOINT_STATE: ("position.0", "velocity.0"),
    WRENCH_STAMPED: (
        "wrench.force.x",
        "wrench.force.y",
        "wrench.force.z",
        "wrench.torque.x",
        "wrench.torque.y",
        "wrench.torque.z",
    ),
    FLOAT: ("data",),
}
"""Paths of the values in each message: angle and velocity [rad, rad/s], force and torque [N, N m],
current [A]."""

OPTIONAL_FIELDS = {JOINT_STATE: ("effort.0",)}
"""Paths of further values, which are missing if unknown: torque of the motor [N m]."""

FRAME = "fin"
"""Frame of the force and name of the joint."""

SECOND_NS = 1_000_000_000

# After the 4-byte CDR encapsulation header, a message with a header starts with its stamp: seconds
# as int32 and nanoseconds as uint32, little-endian.
_STAMP = struct.Struct("<iI")
_STAMP_BYTE = 4
_NUMBER = struct.Struct("<d")


@cache
def type_store() -> Typestore:
    """Return the message definitions of ROS 2, for serialising and deserialising CDR."""
    return get_typestore(Stores.ROS2_HUMBLE)


def cdr(
    kind: str, stamp_ns: int, values: Sequence[float] | str, frame: str = FRAME, joint: str = FRAME
) -> bytes:
    """Return a message as bytes in OMG CDR, as used by ROS 2; the stamp is the time since 1970
    [ns].

    rosbags serialises each kind of message once; the numbers are then written into copies, which is
    seven times faster. Speed matters because the recorder holds Python's lock while the control
    loop waits.
    """
    if isinstance(values, str):
        return serialized(kind, {"data": values})
    blank, places = _template(kind, frame, joint, len(values) > len(FIELDS[kind]))
    data = bytearray(blank)
    if kind != FLOAT:
        _STAMP.pack_into(data, _STAMP_BYTE, *divmod(stamp_ns, SECOND_NS))
    for place, value in zip(places, values, strict=True):
        _NUMBER.pack_into(data, place, value)
    return bytes(data)


@cache
def _template(kind: str, frame: str, joint: str, complete: bool) -> tuple[bytes, tuple[int, ...]]:
    """Return a message serialised by rosbags, and the byte offsets of its values, with the optional
    values if it is `complete`."""
    # Each value gets its own marker (1, 2 and so on), whose bytes are searched for to find the
    # offset.
    paths = FIELDS[kind] + (OPTIONAL_FIELDS.get(kind, ()) if complete else ())
    marks = range(1, 1 + len(paths))
    values: dict[str, object] = dict(zip(paths, marks, strict=True))
    if kind != FLOAT:
        values["header.frame_id"] = frame
    if kind == JOINT_STATE:
        values["name.0"] = joint
    data = serialized(kind, values)
    return data, tuple(data.index(_NUMBER.pack(mark)) for mark in marks)


def serialized(kind: str, values: Mapping[str, object], types: Typestore | None = None) -> bytes:
    """Return a message of any type as bytes, using the general serialiser; `values` are the same as
    in `build_message`."""
    types = types or type_store()
    return bytes(types.serialize_cdr(build_message(types, (Nodetype.NAME, kind), values), kind))


def build_message(types: Typestore, descriptor: Any, values: Mapping[str, Any]) -> Any:
    """Build a field, as described by rosbags, from values keyed by their paths within the field;
    all other numbers are 0, and all other fields are empty.

    Sequences are as long as the paths require. Raises ValueError if a field is unknown or a value
    has the wrong type.
    """
    node, detail = descriptor
    if node is Nodetype.BASE:
        blank = "" if detail[0] == "string" else 0
        value = values.get("", blank)
        if values.keys() - {""} or isinstance(value, str) != isinstance(blank, str):
            raise ValueError(f"no field that accepts {values}")
        # Texts may contain surrogates, e.g. from file names, which UTF-8 cannot represent.
        return value.encode(errors="replace").decode() if isinstance(value, str) else value
    inner: dict[str, dict[str, Any]] = defaultdict(dict)
    for path, value in values.items():
        first, _, rest = path.partition(".")
        inner[first][rest] = value
    fields = _inner_fields(types, descriptor, inner)
    if not inner.keys() <= fields.keys():
        raise ValueError(
            f"no field {', '.join(inner.keys() - fields.keys())!r}; it has "
            f"{', '.join(fields) or 'none'}"
        )
    items = [build_message(types, field, inner[name]) for name, field in fields.items()]
    if node is Nodetype.NAME:
        return types.types[detail](*items)
    (kind, base), _ = detail
    if kind is not Nodetype.BASE or base[0] == "string":
        return items
    # rosbags serialises sequences of numbers from NumPy arrays; NumPy has no types named byte and
    # char as in ROS.
    return np.array(items, {"byte": "int8", "char": "uint8"}.get(base[0], base[0]))


def _inner_fields(types: Typestore, descriptor: Any, inner: Collection[str]) -> dict[str, Any]:
    """Return the descriptors of message fields by name, or of sequence elements by index."""
    node, detail = descriptor
    if node is Nodetype.NAME:
        return dict(types.fielddefs[detail][1])
    element, count = detail
    if node is not Nodetype.ARRAY:
        # A sequence without a fixed length is as long as the paths require.
        count = max((int(index) + 1 for index in inner), default=0)
    return {str(index): element for index in range(count)}


class BagWriter:
    """Writes an MCAP file to a stream, message by message."""

    def __init__(self, stream: object, channel_topics: Sequence[str] = ()) -> None:
        """Start the file; `channel_topics` are additional topics with one number per message."""
        self._types = TYPES | dict.fromkeys(channel_topics, FLOAT)
        self._writer = start_writer(stream)
        store = type_store()
        schemas = {
            kind: self._writer.register_schema(
                kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode()
            )
            for kind in dict.fromkeys(TYPES.values())
        }
        # The MCAP profile for ROS 2 requires this entry; if it is empty, the default quality of
        # service of ROS 2 applies.
        quality = {"offered_qos_profiles": "", IN_FILE: str(FILES["recording"])}
        self._channels = {
            topic: self._writer.register_channel(topic, "cdr", schemas[kind], quality)
            for topic, kind in self._types.items()
        }
        self.flush = self._writer.flush
        self.finish = self._writer.finish
        """Close the chunk and write the index and the footer."""

    def write(self, topic: str, stamp_ns: int, values: Sequence[float] | str) -> None:
        """Add a message with the given values or text to the chunk."""
        data = cdr(self._types[topic], stamp_ns, values)
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)


def start_writer(stream: Any) -> Any:
    """Start an MCAP file with the settings of all softfin bags."""
    writer: Any = Writer(stream, compression=CompressionType.NONE)
    writer.start(profile="ros2", library=f"softfin {importlib.metadata.version('softfin')}")
    return writer
