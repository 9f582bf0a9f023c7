"""Commands in the U-CAT family's flipper messages: a flipper that does not oscillate by itself, and whose zero moves.

Amplitude 0, zero_direction = angle, 20 times a second. The drive takes no velocity, so the zero direction itself goes
at the command's velocity. The messages differ between robots: their type and fields are configuration. No robot of the
family has been met.
"""

import math
import time
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field
from rosbags.interfaces import Nodetype

from softfin.core.configuration import Configuration
from softfin.core.errors import RigError
from softfin.rig.machine import Target
from softfin.rig.ros2.messages import Messages, one_line, type_name
from softfin.rig.ros2.transport import Transport

LONGEST = 1000
"""Most elements of a sequence."""

EARLY_S = 1e-3
"""How long before its time a message may go out [s]: ticks come a little early and late."""


MessageType = Annotated[str, AfterValidator(type_name)]


class FlipperConfig(Configuration):
    """Which message moves the flipper. A field is named by its path: ``zero_direction``, ``flippers.2.amplitude``."""

    type: MessageType
    """Type of the message: package/msg/Type."""
    definitions: dict[MessageType, str] = Field(default_factory=dict)
    """Text of the .msg file of each type that ROS 2 itself does not have, by package/msg/Type."""
    zero_direction: str = "zero_direction"
    """Field that takes the angle [rad]."""
    amplitude: str = "amplitude"
    """Field that takes 0: the flipper does not oscillate by itself."""
    constants: dict[str, float | bool | str] = Field(default_factory=dict)
    """Other fields that must not be 0 or empty, such as a frequency or the flipper's number."""
    rate_hz: float = Field(default=20.0, gt=0, le=100)
    """Messages a second [Hz]."""


class FlipperCommands:
    """Commands as flipper messages: a set-point that goes to the target at its velocity."""

    def __init__(self, transport: Transport, messages: Messages, topic: str, config: FlipperConfig) -> None:
        self._messages, self._config = messages, config
        if config.type not in messages.types.fielddefs:
            raise RigError(f"flipper.type = {config.type}: ROS 2 has no such message; give the text of its .msg file "
                           "in flipper.definitions")  # fmt: skip
        self._encoded(0.0)
        self.publisher = transport.publish(topic, config.type)
        self._target: Target | None = None
        self._setpoint, self._since, self._next = 0.0, 0.0, 0.0

    def send(self, target: Target, angle: float, now: float) -> None:
        """Move on from where the set-point is; from the measured angle where there is none yet."""
        self._setpoint = angle if self._target is None else self._at(now)
        self._target, self._since, self._next = target, now, now
        self.tick(now)

    def tick(self, now: float) -> None:
        """Send the next message, where it is due."""
        if self._target is None or now < self._next - EARLY_S:
            return
        # In step with the first one; what a late tick has missed is not made up for.
        period = 1 / self._config.rate_hz
        self._next += period * (max(math.floor((now - self._next) / period), 0) + 1)
        self.publisher.send(self._encoded(self._at(now)))

    def hold(self, angle: float) -> None:
        """Send one message, then none."""
        self._target = None
        self.publisher.send(self._encoded(angle))

    def _at(self, now: float) -> float:
        assert self._target is not None
        rest = self._target.angle - self._setpoint
        return self._setpoint + math.copysign(min(abs(rest), self._target.velocity * (now - self._since)), rest)

    def _encoded(self, angle: float) -> bytes:
        config, messages = self._config, self._messages
        message = messages.blank(config.type)
        if hasattr(message, "header"):
            message.header = messages.header(time.time_ns(), "")
        values = config.constants | {config.amplitude: 0.0, config.zero_direction: angle}
        try:
            for path, value in values.items():
                put(messages, (Nodetype.NAME, config.type), message, path.split("."), value)
        except (LookupError, ValueError):
            fields = ", ".join(name for name, _ in messages.types.fielddefs[config.type][1])
            raise RigError(
                f"flipper field {path!r} of {config.type}: no field that takes {value!r}; give a path of names and "
                f"indices, as flippers.2.amplitude; the message has {fields}"
            ) from None
        try:
            return messages.encode(message)
        except Exception as error:
            # A constant that a field cannot hold fails in the encoder, each type in a way of its own.
            raise RigError(f"{config.type}: its fields cannot hold these values ({one_line(error)}); correct the "
                           "constants and the names of the fields") from None  # fmt: skip


def put(messages: Messages, descriptor: Any, node: Any, parts: list[str], value: float | bool | str) -> Any:
    """Set the field at the end of a path, and return the changed node; sequences grow as far as the path goes.

    Raises LookupError or ValueError where there is no such field, or one of another kind.
    """
    kind, detail = descriptor
    if kind is Nodetype.BASE:
        if parts or isinstance(value, str) != (detail[0] == "string"):
            raise ValueError
        return value
    first, *rest = parts
    if kind is Nodetype.NAME:
        field = dict(messages.types.fielddefs[detail][1])[first]
        setattr(node, first, put(messages, field, getattr(node, first), rest, value))
        return node
    (element, count), index = detail, int(first)
    if not 0 <= index < (count or LONGEST):
        raise IndexError
    items = [*node, *(messages.blank_value(element) for _ in range(index + 1 - len(node)))]
    items[index] = put(messages, element, items[index], rest, value)
    return np.array(items, node.dtype) if isinstance(node, np.ndarray) else items
