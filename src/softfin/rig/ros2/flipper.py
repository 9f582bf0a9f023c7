"""Messages of the U-CAT family's flippers: one that does not oscillate by itself, and whose zero direction moves.

They differ between robots: their type and fields are configuration. No robot of the family has been met.
"""

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from softfin.core.errors import RigError
from softfin.rig.ros2.config import FlipperConfig
from softfin.rig.ros2.transport import one_line
from softfin.storage.bag.messages import SECOND_NS


def encode_flipper(config: FlipperConfig, types: Typestore, angle: float) -> bytes:
    """The message by which the flipper stands at an angle [rad]; else raises RigError."""
    seconds, rest = divmod(time.time_ns(), SECOND_NS)
    stamp = {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}
    try:
        has_header = "header" in dict(types.fielddefs[config.type][1])
        values = config.constants | {config.amplitude: 0.0, config.zero_direction: angle}
        message = build_message(types, (Nodetype.NAME, config.type), (stamp if has_header else {}) | values)
        return bytes(types.serialize_cdr(message, config.type))
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


def build_message(types: Typestore, descriptor: Any, values: Mapping[str, Any]) -> Any:
    """A field, as rosbags describes it, with values by their paths within it; other numbers are 0, others empty.

    Sequences are as long as the paths go. Raises ValueError where there is no such field, or one of another kind.
    """
    node, detail = descriptor
    if node is Nodetype.BASE:
        blank = "" if detail[0] == "string" else 0
        value = values.get("", blank)
        if values.keys() - {""} or isinstance(value, str) != isinstance(blank, str):
            raise ValueError(f"no field that takes {values}")
        return value
    inner: dict[str, dict[str, Any]] = defaultdict(dict)
    for path, value in values.items():
        first, _, rest = path.partition(".")
        inner[first][rest] = value
    if node is Nodetype.NAME:
        fields = dict(types.fielddefs[detail][1])
    else:
        element, count = detail
        count = count if node is Nodetype.ARRAY else max((int(index) + 1 for index in inner), default=0)
        fields = {str(index): element for index in range(count)}
    if not inner.keys() <= fields.keys():
        raise ValueError(f"no field {', '.join(inner.keys() - fields.keys())!r}; it has {', '.join(fields) or 'none'}")
    items = [build_message(types, field, inner[name]) for name, field in fields.items()]
    if node is Nodetype.NAME:
        return types.types[detail](*items)
    if element[0] is Nodetype.BASE and element[1][0] != "string":
        return np.array(items, {"byte": "int8", "char": "uint8"}.get(element[1][0], element[1][0]))
    return items
