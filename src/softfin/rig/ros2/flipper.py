"""Messages of the U-CAT family's flippers: one that does not oscillate by itself, and whose zero direction moves.

They differ between robots: their type and fields are configuration. No robot of the family has been met.
"""

import time
from collections.abc import Mapping

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.errors import RigError
from softfin.rig.ros2.config import FlipperConfig
from softfin.rig.ros2.connection import one_line
from softfin.storage.bag.messages import SECOND_NS, serialized


def encode_flipper(config: FlipperConfig, types: Typestore, angle: float) -> bytes:
    """The message by which the flipper stands at an angle [rad]; else raises RigError."""
    seconds, rest = divmod(time.time_ns(), SECOND_NS)
    stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}
    try:
        has_header = "header" in dict(types.fielddefs[config.type][1])
        values = config.constants | {config.amplitude: 0.0, config.zero_direction: angle}
        return serialized(config.type, (stamp if has_header else {}) | values, types)
    except Exception as error:
        # Unknown types, fields that are not there and values that do not fit fail in ways of their own.
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise RigError(
            f"flipper: no {config.type} can be made ({reason}); give the .msg text of each type that ROS 2 lacks in "
            "flipper.definitions, and fields as paths of names and indices, as flippers.2.amplitude"
        ) from None


def define_types(definitions: Mapping[str, str]) -> Typestore:
    """ROS 2's own types, and others by the text of their .msg files; raises RigError where that is not such a text."""
    types, kind = get_typestore(Stores.ROS2_HUMBLE), ""
    try:
        for kind, text in definitions.items():
            types.register(get_types_from_msg(text, kind))
    except Exception as error:
        # The parser and the registration fail in ways of their own.
        raise RigError(f"message {kind}: its definition cannot be used ({one_line(error)}); give that of its .msg "
                       "file") from None  # fmt: skip
    return types
