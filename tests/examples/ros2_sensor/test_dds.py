"""The same sensor over DDS, on loopback and in a domain of its own."""

import os
import time
import uuid

import pytest
from examples.ros2_sensor.softfin_ros2_sensor import TopicSensorConfig, TopicSource, topic_sensor

from softfin.core.errors import RigError
from softfin.rig.computer import COMPUTER
from softfin.rig.ros2.config import TransportConfig
from tests import needs
from tests.examples.ros2_sensor.emulated_topic import EmulatedTopic
from tests.patience import HANG_S, wait_until
from tests.rig.still_fin import StillFin

needs.module("cyclonedds", "the extra ros2 is not installed")

from softfin.rig import streamed_sensor  # noqa: E402
from softfin.rig.ros2.connection import BOOL  # noqa: E402
from softfin.rig.ros2.plant import open_transport  # noqa: E402
from softfin.storage.bag.messages import serialized  # noqa: E402

pytestmark = pytest.mark.real_time

CONNECTION = TransportConfig(transport="dds", domain=173)

LOAD = (2.0, -1.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def emulated(monkeypatch):
    monkeypatch.setattr(streamed_sensor, "FIRST_WAIT_S", HANG_S)
    name = f"/emulated_{uuid.uuid4().hex[:8]}/wrench"
    topic = EmulatedTopic(open_transport(CONNECTION), StillFin(*LOAD), 80.0, topic=name)
    yield topic
    topic.close()


@pytest.fixture
def sensor(emulated):
    connection = CONNECTION.model_dump()
    values = {"rate_hz": 80.0, "filter_delay_s": 0.0, "frame": "y,-x", "connection": connection}
    made = topic_sensor(TopicSensorConfig.build(values | emulated.address()))
    yield made
    made.close()


def await_complaint(sensor, words):
    wait_until(lambda: any(words in line for line in (sensor.keep_up(), *sensor.complaints())[1:]))


def test_forces_arrive_and_a_second_program_is_refused(sensor):
    sensor.open()
    assert sensor.measured(0.3)[0][:2] == pytest.approx((2.0, -1.0), abs=0.01)
    with pytest.raises(RigError, match="in use by another"):
        topic_sensor(sensor.config).open()
    sensor.close()
    sensor.open()
    assert sensor.read().wrench[:2] == pytest.approx((2.0, -1.0), abs=0.01)
    assert sensor.read().force_time <= time.monotonic()
    sensor.close()
    assert sensor.counters()["sensor_records"] > 30


def test_a_driver_that_ends_is_a_fault(emulated, sensor):
    sensor.open()
    emulated.unplug()
    await_complaint(sensor, "no longer has a publisher; restart its driver")


def test_a_second_driver_on_the_topic_is_a_fault_that_names_both_processes(emulated, sensor):
    sensor.open()
    transport = open_transport(CONNECTION)
    second = EmulatedTopic(transport, StillFin(*LOAD), 80.0, topic=emulated.topic)
    try:
        await_complaint(sensor, "has 2 publishers (")
        (complaint,) = (line for line in sensor.complaints() if "publishers" in line)
        assert complaint.count(f" {os.getpid()} on ") == 2
    finally:
        second.close()


def test_a_topic_of_another_type_is_named_with_its_type(emulated, sensor):
    emulated.unplug()
    other = open_transport(CONNECTION)
    publisher = other.publish(emulated.topic, BOOL)
    source = TopicSource(sensor.config, COMPUTER)
    source.open()
    wait_until(lambda: f"found {emulated.topic} (std_msgs/msg/Bool)" in source.explain_silence())
    publisher.send(serialized(BOOL, {"data": True}))
    assert not source.take()
    source.close()
    other.close()
