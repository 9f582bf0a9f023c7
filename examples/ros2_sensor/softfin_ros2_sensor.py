"""A force sensor behind a ROS 2 topic: its WrenchStamped messages as records for a
`StreamedSensor`.

The time of a record is its `header.stamp`, mapped to this computer's clock by the message that
arrived fastest, so the driver's clock may be another one. Messages without a stamp are rejected,
because neither their age nor lost messages could be noticed.
"""

import math
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field

from softfin.core.clock import Clock
from softfin.rig.computer import COMPUTER
from softfin.rig.device import CheckResult
from softfin.rig.device_type import ForceSensorType
from softfin.rig.loss_estimate import LossEstimate
from softfin.rig.machine import Wrench
from softfin.rig.ros2.config import TopicName, TransportConfig
from softfin.rig.ros2.connection import (
    Subscription,
    Transport,
    check_frame,
    read_stamp,
    read_wrench,
)
from softfin.rig.ros2.plant import open_transport
from softfin.rig.streamed_sensor import (
    FIRST_WAIT_S,
    MALFORMED_RECORDS,
    RecordSource,
    StreamedSensor,
    StreamedSensorConfig,
    TimedWrench,
    queue_length,
)
from softfin.storage.bag.messages import SECOND_NS, WRENCH_STAMPED

NOTED_DELAY_S = 0.01
"""Shortest time between a message's stamp and its arrival that is noted [s]."""

SAME_CLOCK_S = 1.0
"""Shortest time between a message's stamp and its arrival that means that the stamps are from
another clock [s]."""


class TopicSensorConfig(StreamedSensorConfig):
    """A sensor whose driver publishes geometry_msgs/WrenchStamped, one message per sample, each
    with the time of its sample in `header.stamp`.

    `filter_delay_s` is the total delay from the force until a message arrives, without that of the
    network: that of the sensor's and the driver's filters, and of the driver itself.
    """

    type: Literal["ros2"] = "ros2"
    """A topic of ROS 2."""
    topic: TopicName
    """Topic of the messages, e.g. /ft_sensor/wrench; may have only one publisher."""
    frame_id: str | None = Field(None, min_length=1)
    """Frame in the messages' headers, others than which are rejected; None accepts any frame."""
    connection: TransportConfig = Field(
        default_factory=lambda: TransportConfig(node="softfin_sensor")
    )
    """How to reach the driver."""


def topic_sensor(config: TopicSensorConfig, clock: Clock = COMPUTER) -> StreamedSensor:
    """Return a force sensor behind a topic."""
    return StreamedSensor(config, TopicSource(config, clock), clock)


class TopicSource(RecordSource):
    """The messages on one topic."""

    unit = "message"
    remedy = "check its driver and the network"

    def __init__(self, config: TopicSensorConfig, clock: Clock) -> None:
        super().__init__(config.topic, "ros2", config.connection.domain, config.topic)
        self.config = config
        self.clock = clock
        self._transport: Transport | None = None
        self._messages: Subscription[Wrench] | None = None
        self._reset()

    def _reset(self) -> None:
        self.counted.clear()
        self._loss = LossEstimate(self.config.rate_hz)
        self._newest: float | None = None
        """Time of the latest message [s]."""
        self._unusable_in_a_row = 0
        self._frame_id = ""
        self._delay_s = math.inf
        """Shortest time so far between a message's stamp and its processing [s], if both clocks
        agree."""

    def open(self) -> None:
        """Subscribe to the topic; raises RigError or DeviceError."""
        self._reset()
        config = self.config
        self._transport = open_transport(config.connection)
        # Best effort matches every publisher, and a message that is sent again would be too late.
        self._messages = Subscription(
            self._transport,
            config.topic,
            WRENCH_STAMPED,
            self._read,
            quality="best_effort",
            depth=queue_length(config.rate_hz),
        )

    def take(self) -> list[TimedWrench]:
        """Return the usable messages that have arrived."""
        messages = self._open_messages()
        unusable = messages.refused + messages.not_newer
        records = [self._number(time, wrench) for time, wrench in messages.take()]
        if records:
            self._unusable_in_a_row = 0
        else:
            self._unusable_in_a_row += messages.refused + messages.not_newer - unusable
        self.counted["records"] = messages.received
        self.counted["late"] = messages.not_newer
        self.counted["malformed"] = messages.refused
        return records

    def describe(self) -> str:
        """Return the type of the messages and their frame."""
        return f"WrenchStamped in the frame {self._frame_id!r}"

    def checks(self) -> Iterator[CheckResult]:
        """Note a delay before the messages' arrival, for which softfin does not correct."""
        if NOTED_DELAY_S < self._delay_s < SAME_CLOCK_S:
            text = (
                f"messages arrive {1e3 * self._delay_s:.0f} ms after their time stamps; if both "
                "clocks agree, include this delay in filter_delay_s"
            )
            yield CheckResult("force sensor", "note", text)
        elif not 0 <= self._delay_s < SAME_CLOCK_S:
            text = (
                "time stamps are from another clock, so the delay between them and the messages' "
                "arrival is unknown; include it in filter_delay_s"
            )
            yield CheckResult("force sensor", "note", text)

    def explain_silence(self) -> str:
        """Return why the messages are rejected, or the topics that were found."""
        return self._without_topic(self._open_messages().explain_silence(FIRST_WAIT_S))

    def complaints(self) -> list[str]:
        """Return the faults of the publishers and of the messages."""
        messages = self._open_messages()
        lines = []
        if problem := messages.explain_publishers():
            lines.append(self._without_topic(problem))
        if self._unusable_in_a_row >= MALFORMED_RECORDS:
            lines.append(
                self._without_topic(messages.refusal or "")
                or "time stamps do not increase; check its driver's clock, then start again"
            )
        return lines

    def notes(self) -> tuple[str, ...]:
        """Return the notes on the connection."""
        return () if self._transport is None else self._transport.notes

    def close(self) -> None:
        """Leave the topic; may be called repeatedly and never raises."""
        # Readers are closed with their last reference.
        self._messages = None
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _open_messages(self) -> Subscription[Wrench]:
        assert self._messages is not None, "StreamedSensor uses open sources only"
        return self._messages

    def _without_topic(self, line: str) -> str:
        """Return a line without the topic at its start, which the sensor's name contains."""
        return line.removeprefix(f"{self.config.topic}: ")

    def _read(self, message: Any) -> Wrench:
        """Return the wrench in a message; raises ValueError if it is not usable."""
        stamp_ns = read_stamp(message)
        if not stamp_ns:
            raise ValueError("its header.stamp is 0, but must be the time of the sample")
        if self.config.frame_id is not None:
            check_frame(message, self.config.frame_id)
        wrench = read_wrench(message)
        self._frame_id = message.header.frame_id
        self._delay_s = min(self._delay_s, self.clock.wall() - stamp_ns / SECOND_NS)
        return wrench

    def _number(self, time: float, wrench: Wrench) -> TimedWrench:
        """Return a record with the number of messages that are missing before it."""
        missing = 0
        if self._newest is not None:
            missing = self._loss.missing(time - self._newest)
        self._newest = time
        self.counted["lost"] += missing
        return TimedWrench(np.array(wrench), missing, time)


ROS2 = ForceSensorType(TopicSensorConfig, topic_sensor)
"""The type `ros2`, named by the entry point in pyproject.toml."""
