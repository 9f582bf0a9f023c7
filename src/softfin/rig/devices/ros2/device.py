"""The type `ros2`: a force sensor behind a ROS 2 topic."""

from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.ros2.config import TopicSensorConfig
from softfin.rig.devices.ros2.sensor import topic_sensor

ROS2 = ForceSensorType(TopicSensorConfig, topic_sensor)
