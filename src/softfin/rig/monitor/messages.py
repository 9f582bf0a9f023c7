"""A ROS 2 message of a recording in, the numbers that the monitor shows out, or the text of an event."""

from collections.abc import Callable
from typing import Any, TypeAlias

from softfin.core.printable import printable
from softfin.storage.bag.messages import type_store

Values: TypeAlias = tuple[float | str, ...]

MOST_BYTES = 65_536
"""Of a message that is decoded at all; ours have 100 to 300."""

MOST_CHARACTERS = 300
"""Of an event's text that is shown."""

TOPICS = {
    "/fin/joint_states": "joint",
    "/fin/wrench": "wrench",
    "/fin/command": "command",
    "/fin/reference": "reference",
    "/fin/current": "current",
    "/fin/events": "event",
}
"""As recordings are written, and the role of each."""

_PAIR = "std_msgs/msg/Float64MultiArray"
_JOINT = "sensor_msgs/msg/JointState"
_WRENCH = "geometry_msgs/msg/WrenchStamped"

TYPES: dict[str, tuple[str, ...]] = {
    "joint": (_JOINT,),
    "wrench": (_WRENCH,),
    "command": (_JOINT, _PAIR),
    "reference": (_WRENCH,),
    "current": ("std_msgs/msg/Float64",),
    "event": ("std_msgs/msg/String",),
}

NAMES = {
    "joint": ("angle_rad", "velocity_rad_s"),
    "wrench": ("force_x_n", "force_y_n"),
    "command": ("angle_rad", "velocity_rad_s"),
    "reference": ("force_x_n", "force_y_n"),
    "current": ("current_a",),
    "event": ("text",),
}
"""What the values of each role are."""


def decoded(role: str, kind: str, data: bytes) -> Values | None:
    """The values of a message; None where it is not what its type says."""
    if len(data) > MOST_BYTES or kind not in TYPES[role]:
        return None
    try:
        return _VALUES[kind](type_store().deserialize_cdr(data, kind))
    except Exception:
        # Generated code reads what a stranger may have written, and fails in ways of its own; the caller counts it.
        return None


def _joint(message: Any) -> Values:
    velocity = message.velocity[0] if len(message.velocity) else float("nan")
    return float(message.position[0]), float(velocity)


def _pair(message: Any) -> Values:
    angle, velocity = message.data
    return float(angle), float(velocity)


def _wrench(message: Any) -> Values:
    return float(message.wrench.force.x), float(message.wrench.force.y)


_VALUES: dict[str, Callable[[Any], Values]] = {
    _JOINT: _joint,
    _PAIR: _pair,
    _WRENCH: _wrench,
    "std_msgs/msg/Float64": lambda message: (float(message.data),),
    "std_msgs/msg/String": lambda message: (printable(message.data, most=MOST_CHARACTERS),),
}
