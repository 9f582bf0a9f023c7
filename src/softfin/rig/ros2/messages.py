"""ROS 2 messages without ROS: rosbags' types and their CDR, and what softfin takes from them and puts into them; pure.

A message that says something else than it should raises ValueError with the reason; who takes messages counts them.
"""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
import pydantic
from jaxtyping import Float
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from softfin.core.errors import RigError
from softfin.rig.machine import Wrench

JOINT = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
BOOL = "std_msgs/msg/Bool"

TopicName = Annotated[str, pydantic.StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")]
"""A full name, as ``/fin/wrench``: no relative ones, no ``~``."""


class Messages:
    """Message types by name: those of ROS 2 Humble, and others whose definition is given as text."""

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        self.types = get_typestore(Stores.ROS2_HUMBLE)
        given = definitions or {}
        for kind, text in given.items():
            with _told(kind):
                self.types.register(get_types_from_msg(text, kind))
        for kind in given:
            with _told(kind):
                self._check(kind)

    def make(self, kind: str, *values: Any) -> Any:
        """A message of its fields, in order."""
        return self.types.types[kind](*values)

    def encode(self, message: Any) -> bytes:
        """CDR with its header of four bytes, little-endian."""
        return bytes(self.types.serialize_cdr(message, message.__msgtype__))

    def decode(self, data: bytes, kind: str) -> Any:
        """From CDR; ValueError where the bytes are no such message."""
        try:
            return self.types.deserialize_cdr(data, kind)
        except Exception as error:
            # Bytes that anybody sent fail at any step of the decoder.
            reason = " ".join(str(error).split())[:100] or type(error).__name__
            raise ValueError(f"{len(data)} bytes that are no {kind} ({reason})") from None

    def blank(self, kind: str) -> Any:
        """A message whose every number is 0, and whose texts and sequences are empty."""
        return self.types.types[kind](*(self.blank_value(descriptor) for _, descriptor in self._fields(kind)))

    def blank_value(self, descriptor: Any) -> Any:
        """Of one field, as rosbags describes it."""
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

    def _fields(self, kind: str) -> Any:
        return self.types.fielddefs[kind][1]

    def _check(self, kind: str) -> None:
        """Every type in it is there, none within itself: KeyError, RecursionError."""
        for _, (node, detail) in self._fields(kind):
            inner = detail if node in (Nodetype.NAME, Nodetype.BASE) else detail[0][1]
            if isinstance(inner, str):
                self._check(inner)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Of every message with a stamp."""
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


@contextlib.contextmanager
def _told(kind: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        # The parser, the registration and a type that is not there fail in ways of their own.
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise RigError(f"message {kind}: its definition cannot be used ({reason}); give that of its .msg file, and one "
                       "for each type of its own in it") from None  # fmt: skip


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
    """Force and torque as they stand there."""
    force, torque = message.wrench.force, message.wrench.torque
    return (
        _finite("force x", force.x), _finite("force y", force.y), _finite("force z", force.z),
        _finite("torque x", torque.x), _finite("torque y", torque.y), _finite("torque z", torque.z),
    )  # fmt: skip


def reference_of(message: Any, frame: str) -> tuple[float, float]:
    """The force that is asked for, from a WrenchStamped or a Vector3Stamped in our frame, or without one."""
    theirs = message.header.frame_id
    if theirs not in ("", frame):
        raise ValueError(f"it is in the frame {theirs!r}; this node's is {frame!r}")
    vector = message.wrench.force if hasattr(message, "wrench") else message.vector
    return _finite("x", vector.x), _finite("y", vector.y)


def turned(wrench: Wrench, rotation: Float[np.ndarray, "3 3"]) -> Wrench:
    """Force and torque in other axes."""
    fx, fy, fz, tx, ty, tz = (np.reshape(wrench, (2, 3)) @ rotation.T).ravel().tolist()
    return fx, fy, fz, tx, ty, tz


def type_name(kind: str) -> str:
    """``package/msg/Type``, as ROS 2 and rosbags write it, from that or from ``package/Type``."""
    parts = kind.split("/")
    if len(parts) == 2:
        parts.insert(1, "msg")
    if len(parts) != 3 or not all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", part) for part in parts):
        raise ValueError(f"{kind!r} is no message type; write package/msg/Type")
    return "/".join(parts)


def _finite(what: str, value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"its {what} is {number}")
    return number
