"""Commands in the U-CAT family's flipper messages: a flipper that does not oscillate by itself, and whose zero moves.

Amplitude 0, zero_direction = angle, 20 times a second. The drive takes no velocity, so the zero direction itself goes
at the command's velocity. The messages differ between robots: their type and fields are configuration. No robot of the
family has been met.
"""

import math
import re
import time
from functools import partial
from operator import setitem
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from softfin.core.configuration import Configuration
from softfin.core.errors import RigError
from softfin.rig.machine import Target
from softfin.rig.ros2.messages import Messages, one_line, type_name
from softfin.rig.ros2.transport import Transport

PART = re.compile(r"[A-Za-z][A-Za-z0-9_]*|[0-9]{1,3}")

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
    parts = path.split(".")
    if not all(PART.fullmatch(part) for part in parts):
        raise ValueError("a path is names and numbers with dots between, as flippers.2.amplitude")
    kind, detail, node = "NAME", message.__msgtype__, message
    for part in parts:
        if kind == "NAME":
            fields = dict(messages.types.fielddefs[detail][1])
            if part not in fields:
                raise ValueError(f"{detail} has no field {part!r}; it has {', '.join(fields)}")
            assign, descriptor, node = partial(setattr, node, part), fields[part], getattr(node, part)
        elif kind == "BASE" or not part.isdecimal():
            raise ValueError(f"{part!r} is not an element of it; a sequence's are numbers from 0 on")
        else:
            index, (descriptor, count) = int(part), detail
            if count and index >= count:
                raise ValueError(f"it has {count} elements, 0 to {count - 1}; there is no {index}")
            if index >= len(node):
                added = [messages.blank_value(descriptor) for _ in range(index + 1 - len(node))]
                is_array = isinstance(node, np.ndarray)
                node = np.concatenate([node, np.array(added, node.dtype)]) if is_array else [*node, *added]
                assign(node)
            assign, node = partial(setitem, node, index), node[index]
        kind, detail = descriptor[0].name, descriptor[1]
    if kind != "BASE":
        raise ValueError("it is not a number, but has parts of its own; name one of them")
    if isinstance(value, str) != (detail[0] == "string"):
        raise ValueError(f"it is of type {detail[0]}, which {value!r} is not")
    assign(value)
