"""An emulated driver that publishes the force of an emulated fin as WrenchStamped."""

import uuid
from typing import NamedTuple

from softfin.core.json_object import JsonObject
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.stream import EmulatedStream
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.machine import Wrench
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import Publisher
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
    """Emulated driver on a topic, by default a new one, so that several emulators do not meet;
    `connection` is by DDS on this computer by default."""

    def __init__(
        self,
        fin: EmulatedFin,
        rate_hz: float,
        clock: Computer = COMPUTER,
        connection: TransportConfig | None = None,
        topic: str | None = None,
    ) -> None:
        self.topic = topic or f"/emulated_{uuid.uuid4().hex[:8]}/wrench"
        self._connection = connection or TransportConfig(transport="dds")
        self._started_s = clock.wall()
        self._transport = clock.open_topics(self._connection)
        self._publisher: Publisher | None = self._transport.publish(self.topic, WRENCH_STAMPED)
        super().__init__(fin, rate_hz, clock)

    def address(self) -> JsonObject:
        """Return the topic and how to reach it, as in a rig's file."""
        connection = self._connection.model_copy(update={"domain": self._connection.domain_id()})
        return {
            "topic": self.topic,
            "connection": connection.model_dump(mode="json", exclude_defaults=True),
        }

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
