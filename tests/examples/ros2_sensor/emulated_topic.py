"""An emulated driver that publishes the force of an emulated fin as WrenchStamped."""

from typing import NamedTuple

from softfin.core.clock import Clock
from softfin.core.json_object import JsonObject
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.stream import EmulatedStream
from softfin.rig.computer import COMPUTER
from softfin.rig.machine import Wrench
from softfin.rig.ros2.connection import Publisher, Transport
from softfin.storage.bag.messages import SECOND_NS, WRENCH_STAMPED, cdr


class EmulatedMessage(NamedTuple):
    """A message of the emulated driver."""

    stamp_ns: int
    """Time of the sample since 1970 [ns]."""
    wrench: Wrench
    """Force and torque in the sensor's axes [N, N m]."""
    frame_id: str = "ft_sensor"
    """Frame in the header."""


class EmulatedTopic(EmulatedStream[EmulatedMessage]):
    """Emulated driver on a topic."""

    def __init__(
        self,
        transport: Transport,
        fin: EmulatedFin,
        rate_hz: float,
        clock: Clock = COMPUTER,
        topic: str = "/ft_sensor/wrench",
    ) -> None:
        self.topic = topic
        self._started_s = clock.wall()
        self._transport = transport
        self._publisher: Publisher | None = transport.publish(topic, WRENCH_STAMPED)
        super().__init__(fin, rate_hz, clock)

    def address(self) -> JsonObject:
        """Return the topic, as in a rig's file."""
        return {"topic": self.topic}

    def encode(self, age_s: float, wrench: Wrench) -> EmulatedMessage:
        """Return a message."""
        return EmulatedMessage(round((self._started_s + age_s) * SECOND_NS), wrench)

    def send(self, record: EmulatedMessage) -> None:
        """Publish a message."""
        publisher = self._publisher
        if publisher is not None:
            publisher.send(cdr(WRENCH_STAMPED, record.stamp_ns, record.wrench, record.frame_id))

    def unplug(self) -> None:
        """Remove the publisher, as when the driver ends; may be called repeatedly."""
        # A writer is closed with its last reference.
        self._publisher = None
        self._transport.close()
