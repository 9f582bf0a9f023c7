"""The type `ros2`: a force sensor behind a ROS 2 topic, and its emulator."""

from softfin.core.clock import Clock
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.rig.device import EmulatedDevice, ForceSensorType
from softfin.rig.devices.ros2.config import TopicSensorConfig
from softfin.rig.devices.ros2.sensor import topic_sensor


def _emulated_config() -> TopicSensorConfig:
    # Imported here because a real rig does not need it.
    from softfin.emulation.topic import EMULATED_RATE_HZ

    values = {
        "topic": "/emulated/wrench",
        "rate_hz": EMULATED_RATE_HZ,
        "filter_delay_s": 0.0,
        "frame": SENSOR_MOUNTING,
    }
    return TopicSensorConfig.build(values, "emulated sensor")


def _emulate(config: TopicSensorConfig, fin: EmulatedFin, clock: Clock) -> EmulatedDevice:
    from softfin.emulation.topic import EmulatedTopic

    # In real time, several emulated rigs may share this computer.
    topic = config.topic if isinstance(clock, SimulatedClock) else None
    return EmulatedTopic(fin, config.rate_hz, clock, topic=topic)


ROS2 = ForceSensorType(TopicSensorConfig, topic_sensor, _emulated_config, _emulate)
