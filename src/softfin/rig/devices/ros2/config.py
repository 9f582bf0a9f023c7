"""Configuration of a force sensor behind a ROS 2 topic."""

from typing import Literal

from pydantic import Field

from softfin.rig.ros2.config import TopicName, TransportConfig
from softfin.rig.streamed_sensor import StreamedSensorConfig


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
