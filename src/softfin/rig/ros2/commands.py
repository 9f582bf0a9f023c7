"""Commands to somebody else's drive as sensor_msgs/JointState: position, and the velocity on the way there."""

import time
from typing import Protocol, runtime_checkable

from softfin.rig.machine import Target
from softfin.rig.ros2.messages import JOINT, Messages
from softfin.rig.ros2.transport import Transport


@runtime_checkable
class Commands(Protocol):
    """What a Ros2Machine tells its drive."""

    def listeners(self) -> int:
        """Who would obey."""
        ...

    def send(self, target: Target, angle: float, now: float) -> None:
        """Go there from now on, from the measured angle."""
        ...

    def tick(self, now: float) -> None:
        """Called at every tick while it is enabled, for drives that must hear more often."""
        ...

    def hold(self, angle: float) -> None:
        """Go no further: the last message until the next `send`."""
        ...


class JointCommands:
    """One message for each command; the driver holds it."""

    def __init__(self, transport: Transport, messages: Messages, topic: str, joint: str, velocity: float) -> None:
        self._messages, self._joint, self._velocity = messages, joint, velocity
        self._outlet = transport.publish(topic, JOINT)

    def listeners(self) -> int:
        """Matched readers."""
        return self._outlet.listeners()

    def send(self, target: Target, angle: float, now: float) -> None:
        """Whatever the measured angle is."""
        message = self._messages.joint(time.time_ns(), "", self._joint, target.angle, target.velocity)
        self._outlet.send(self._messages.encode(message))

    def tick(self, now: float) -> None:
        """Nothing."""

    def hold(self, angle: float) -> None:
        """At the velocity that it was made with."""
        self.send(Target(angle, self._velocity), angle, 0.0)
