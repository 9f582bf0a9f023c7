"""An emulated driver that publishes the force of an emulated fin, with noise, as WrenchStamped."""

import contextlib
import uuid
from collections.abc import Callable, Iterable
from typing import NamedTuple

from softfin.core.errors import DeviceError
from softfin.core.json_object import JsonObject
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.emulation.stream import iterate_due, measure
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.machine import Wrench, rotation
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


class EmulatedTopic:
    """Emulated driver, running from construction until `close`; faults may be set from any
    thread."""

    def __init__(
        self,
        fin: EmulatedFin,
        rate_hz: float,
        clock: Computer = COMPUTER,
        frame: str = SENSOR_MOUNTING,
        connection: TransportConfig | None = None,
        topic: str | None = None,
    ) -> None:
        """`topic` is a new one by default, so that several emulators do not meet; `connection` is
        by DDS on this computer by default."""
        self.transmit: Callable[[EmulatedMessage], Iterable[EmulatedMessage]]
        self.transmit = lambda message: (message,)
        """Function that maps a message to those that are published; tests may double, lose, delay
        or change messages."""
        self.rate_hz = rate_hz
        self.are_values_frozen = False
        self.topic = topic or f"/emulated_{uuid.uuid4().hex[:8]}/wrench"
        self._connection = connection or TransportConfig(transport="dds")
        self._fin = fin
        self._clock = clock
        self._rotation = rotation(frame).T
        self._wrench: Wrench = (0.0,) * 6
        self._silent_until = 0.0
        self._closing = clock.event()
        self._transport = clock.open_topics(self._connection)
        self._publisher: Publisher | None = self._transport.publish(self.topic, WRENCH_STAMPED)
        self._thread = clock.spawn(self._run, "emulated topic")

    def address(self) -> JsonObject:
        """Return the topic and how to reach it, as in a rig's file."""
        connection = self._connection.model_copy(update={"domain": self._connection.domain_id()})
        return {
            "topic": self.topic,
            "connection": connection.model_dump(mode="json", exclude_defaults=True),
        }

    def description(self) -> str:
        """Return the topic and its domain."""
        return f"{self.topic} in ROS domain {self._connection.domain_id()}"

    def remembered(self) -> JsonObject:
        """Return nothing: softfin keeps the zero."""
        return {}

    def recall(self, remembered: JsonObject) -> None:
        """Continue; there is nothing to recall."""

    def silence(self, seconds: float = float("inf")) -> None:
        """Publish nothing for a time [s]; 0 ends the silence."""
        self._silent_until = self._clock() + seconds

    def unplug(self) -> None:
        """Remove the publisher, as when the driver ends."""
        # A writer is closed with its last reference.
        self._publisher = None
        self._transport.close()

    def close(self) -> None:
        """Stop the driver; may be called repeatedly."""
        self._closing.set()
        self._thread.join()
        self.unplug()

    def _run(self) -> None:
        started = self._clock.wall()
        for numbers in iterate_due(self._clock, self._closing, lambda: self.rate_hz):
            is_silent = self._clock() < self._silent_until
            for number in numbers:
                message = self._measure(number, started)
                for sent in () if is_silent else self.transmit(message):
                    self._publish(sent)

    def _measure(self, number: int, started: float) -> EmulatedMessage:
        if not self.are_values_frozen:
            self._wrench = measure(self._fin, self._rotation, number)
        stamp_s = started + (number + 1) / self.rate_hz
        return EmulatedMessage(round(stamp_s * SECOND_NS), self._wrench)

    def _publish(self, message: EmulatedMessage) -> None:
        publisher = self._publisher
        if publisher is None:
            return
        data = cdr(WRENCH_STAMPED, message.stamp_ns, message.wrench, message.frame_id)
        # A slow reader must not end the driver.
        with contextlib.suppress(DeviceError):
            publisher.send(data)
