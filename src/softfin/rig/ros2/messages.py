"""ROS 2 messages without ROS: rosbags' types and their CDR, and the values that softfin reads from and writes to them.

A message with unusable content raises ValueError with the reason.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from softfin.core.errors import RigError
from softfin.rig.machine import Wrench

JOINT = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
BOOL = "std_msgs/msg/Bool"


class Messages:
    """Message types by name: those of ROS 2 Humble, and others whose definition is given as text."""

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        self.types = get_typestore(Stores.ROS2_HUMBLE)
        definitions = definitions or {}
        kind = ""
        try:
            for kind, text in definitions.items():
                self.types.register(get_types_from_msg(text, kind))
            for kind in definitions:
                self._check(kind)
        except Exception as error:
            # The parser, the registration and a type that is not there fail in ways of their own.
            raise RigError(f"message {kind}: its definition cannot be used ({one_line(error)}); give that of its .msg "
                           "file, and one for each type of its own in it") from None  # fmt: skip

    def make(self, kind: str, *values: Any) -> Any:
        """A message from its fields, in order."""
        return self.types.types[kind](*values)

    def encode(self, message: Any) -> bytes:
        """CDR with its header of four bytes, little-endian."""
        return bytes(self.types.serialize_cdr(message, message.__msgtype__))

    def decode(self, data: bytes, kind: str) -> Any:
        """A message from CDR; raises ValueError where the bytes are not such a message."""
        try:
            return self.types.deserialize_cdr(data, kind)
        except Exception as error:
            # Bytes that anybody sent fail at any step of the decoder.
            raise ValueError(f"{len(data)} bytes that are no {kind} ({one_line(error)})") from None

    def blank(self, kind: str) -> Any:
        """A message whose every number is 0, and whose texts and sequences are empty."""
        return self.make(kind, *(self.blank_value(descriptor) for _, descriptor in self.types.fielddefs[kind][1]))

    def blank_value(self, descriptor: Any) -> Any:
        """The blank value of one field, as rosbags describes it."""
        node, detail = descriptor
        if node is Nodetype.NAME:
            return self.blank(detail)
        if node is Nodetype.BASE:
            return {"string": "", "bool": False}.get(detail[0], 0)
        element, count = detail
        length = count if node is Nodetype.ARRAY else 0
        if element[0] is Nodetype.BASE and element[1][0] != "string":
            return np.zeros(length, {"byte": "int8", "char": "uint8"}.get(element[1][0], element[1][0]))
        return [self.blank_value(element) for _ in range(length)]

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A header with the time since 1970 [ns]."""
        seconds, rest = divmod(stamp_ns, 10**9)
        return self.make("std_msgs/msg/Header", self.make("builtin_interfaces/msg/Time", seconds, rest), frame)

    def joint(self, stamp_ns: int, frame: str, name: str, angle: float, velocity: float) -> Any:
        """One joint's angle [rad] and velocity [rad/s]: measured or commanded."""
        values = (np.array([angle]), np.array([velocity]), np.zeros(0))
        return self.make(JOINT, self.header(stamp_ns, frame), [name], *values)

    def wrench(self, stamp_ns: int, frame: str, wrench: Wrench) -> Any:
        """Force [N] and torque [N m]."""
        parts = (self.make("geometry_msgs/msg/Vector3", *map(float, part)) for part in (wrench[:3], wrench[3:]))
        return self.make(WRENCH, self.header(stamp_ns, frame), self.make("geometry_msgs/msg/Wrench", *parts))

    def _check(self, kind: str) -> None:
        """Raise KeyError where a type in it is missing, RecursionError where it is within itself."""
        for _, (node, detail) in self.types.fielddefs[kind][1]:
            inner = detail if node in (Nodetype.NAME, Nodetype.BASE) else detail[0][1]
            if isinstance(inner, str):
                self._check(inner)


def one_line(error: Exception) -> str:
    """The message of an error of any library, in one short line."""
    return " ".join(str(error).split())[:160] or type(error).__name__


def stamp_of(message: Any) -> int:
    """Time since 1970 in its header [ns]; 0 where there is none."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def joint_of(message: Any, name: str) -> tuple[float, float | None]:
    """Angle and velocity of the joint of that name; the velocity None where the message has none."""
    names = list(message.name)
    if name not in names:
        raise ValueError(f"no joint {name!r} in it; it has {', '.join(map(repr, names[:10])) or 'none'}")
    index = names.index(name)
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        counts = f"{len(names)} names, {len(message.position)} positions, {len(message.velocity)} velocities"
        raise ValueError(f"{counts}; as many of each are needed, or no velocities")
    angle = _finite("position", message.position[index])
    return angle, _finite("velocity", message.velocity[index]) if len(message.velocity) else None


def wrench_of(message: Any) -> Wrench:
    """Force and torque in the message's own axes."""
    parts = (("force", message.wrench.force), ("torque", message.wrench.torque))
    fx, fy, fz, tx, ty, tz = (_finite(f"{name} {axis}", getattr(part, axis)) for name, part in parts for axis in "xyz")
    return fx, fy, fz, tx, ty, tz


def reference_of(message: Any, frame: str) -> tuple[float, float]:
    """The reference force of a WrenchStamped or a Vector3Stamped in our frame, or without one."""
    theirs = message.header.frame_id
    if theirs not in ("", frame):
        raise ValueError(f"it is in the frame {theirs!r}; this node's is {frame!r}")
    vector = message.wrench.force if hasattr(message, "wrench") else message.vector
    return _finite("x", vector.x), _finite("y", vector.y)


def type_name(kind: str) -> str:
    """``package/msg/Type``, as ROS 2 and rosbags write it, from that or from ``package/Type``."""
    parts = kind.split("/")
    if len(parts) == 2:
        parts.insert(1, "msg")
    if len(parts) != 3 or not all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", part) for part in parts):
        raise ValueError(f"{kind!r} is not a message type; write package/msg/Type")
    return "/".join(parts)


def _finite(name: str, value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"its {name} is {number}")
    return number
