"""Commands in the U-CAT family's flipper messages: a flipper that does not beat, and whose zero direction moves.

Amplitude 0, zero_direction = angle, 20 times a second. The drive takes no velocity, so the zero direction itself goes
at the command's velocity. The messages differ between robots: their type and fields are configuration. No robot of the
family has been met.
"""

import math
import re
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

EARLY_S = 1e-3
"""A message may go out so much before its time [s]: ticks come a little early and late."""


MessageType = Annotated[str, AfterValidator(type_name)]


class FlipperConfig(Configuration):
    """Which message moves the flipper. A field is named by its path: ``zero_direction``, ``flippers.2.amplitude``."""

    type: MessageType
    """package/msg/Type of the message."""
    definitions: dict[MessageType, str] = Field(default_factory=dict)
    """package/msg/Type to the text of its .msg file, for each type that ROS 2 itself does not have."""
    zero_direction: str = "zero_direction"
    """Field that takes the angle [rad]."""
    amplitude: str = "amplitude"
    """Field that takes 0: the flipper does not beat by itself."""
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
        """Start from where the set-point is, or from the measured angle where there is none yet."""
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
        distance = self._target.angle - self._setpoint
        passed = self._target.velocity * (now - self._since)
        return self._setpoint + math.copysign(min(abs(distance), passed), distance)

    def _encoded(self, angle: float) -> bytes:
        config, messages = self._config, self._messages
        message = messages.blank(config.type)
        if hasattr(message, "header"):
            message.header = messages.header(time.time_ns(), "")
        for path, value in (config.constants | {config.amplitude: 0.0, config.zero_direction: angle}).items():
            try:
                put(messages, message, path, value)
            except ValueError as error:
                raise RigError(f"flipper field {path!r} of {config.type}: {error}") from None
        try:
            return messages.encode(message)
        except Exception as error:
            # A constant that a field cannot hold fails in the encoder, each type in a way of its own.
            raise RigError(f"{config.type}: its fields cannot hold these values ({one_line(error)}); correct the "
                           "constants and the names of the fields") from None  # fmt: skip


def put(messages: Messages, message: Any, path: str, value: float | bool | str) -> None:
    """Set the field at the end of a path such as ``flippers.2.amplitude``; sequences grow as far as it goes."""
    node, descriptor = message, (Nodetype.NAME, message.__msgtype__)
    parent: Any = None
    key: Any = None
    for part in path.split("."):
        kind, detail = descriptor
        if kind is Nodetype.NAME:
            fields = dict(messages.types.fielddefs[detail][1])
            if part not in fields:
                raise ValueError(f"{detail} has no field {part!r}; it has {', '.join(fields)}")
            parent, key, descriptor, node = node, part, fields[part], getattr(node, part)
            continue
        if kind is Nodetype.BASE or not re.fullmatch("[0-9]{1,3}", part):
            raise ValueError(f"{part!r} is not an element of it; those of a sequence are numbers from 0 to 999")
        (element, count), index = detail, int(part)
        if count and index >= count:
            raise ValueError(f"it has {count} elements, 0 to {count - 1}; there is no {index}")
        if index >= len(node):
            more = [messages.blank_value(element) for _ in range(index + 1 - len(node))]
            node = np.append(node, more).astype(node.dtype) if isinstance(node, np.ndarray) else [*node, *more]
            _set(parent, key, node)
        parent, key, descriptor, node = node, index, element, node[index]
    if descriptor[0] is not Nodetype.BASE:
        raise ValueError("it is not a number, but has parts of its own; name one of them")
    if isinstance(value, str) != (descriptor[1][0] == "string"):
        raise ValueError(f"it is of type {descriptor[1][0]}, which {value!r} is not")
    _set(parent, key, value)


def _set(holder: Any, key: Any, value: Any) -> None:
    if isinstance(key, str):
        setattr(holder, key, value)
    else:
        holder[key] = value
