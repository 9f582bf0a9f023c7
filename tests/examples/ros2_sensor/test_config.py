"""The file of a sensor behind a ROS 2 topic."""

import re
import tomllib
from importlib.metadata import EntryPoint

import pytest
import yaml
from examples.ros2_sensor.softfin_ros2_sensor import TopicSensorConfig

from softfin.core.errors import ConfigurationError
from softfin.rig.config import RigConfig
from softfin.rig.device import is_address
from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.registry import GROUP
from tests.documents import ROOT
from tests.examples.ros2_sensor.installed import install
from tests.rig.rigs import simulated

VALUES = {
    "type": "ros2",
    "topic": "/ft_sensor/wrench",
    "rate_hz": 500,
    "filter_delay_s": 0.01,
    "frame": "x,y",
}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"topic": "wrench"}, "topic = 'wrench'"),
        ({"rate_hz": 5}, "rate_hz = 5"),
        ({"rate_hz": 5000}, "rate_hz = 5000"),
        ({"filter_delay_s": -0.1}, "filter_delay_s = -0.1"),
        ({"frame_id": ""}, "frame_id = ''"),
        ({"connection": {"domain": 233}}, "connection.domain = 233"),
        ({"topics": "/wrench"}, "unknown key 'topics'; did you mean 'topic'"),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused(changes, words):
    assert TopicSensorConfig.build(VALUES).topic == "/ft_sensor/wrench"
    with pytest.raises(ConfigurationError, match=words.replace(".", r"\.")):
        TopicSensorConfig.build(VALUES | changes)


@pytest.mark.parametrize("name", ["topic", "rate_hz", "filter_delay_s", "frame"])
def test_what_depends_on_the_sensor_has_no_default(name):
    values = {key: value for key, value in VALUES.items() if key != name}
    with pytest.raises(ConfigurationError, match=f"{name}: missing required key"):
        TopicSensorConfig.build(values)


def test_a_sensor_too_slow_for_the_loop_is_refused(monkeypatch):
    install(monkeypatch)
    with simulated() as behind:
        values = behind.values(sensor=VALUES | {"rate_hz": 10})
    with pytest.raises(ConfigurationError, match=r"at 10 records per second .* use 0\.31 or more"):
        RigConfig.build(values)
    values["safety"]["force_stale_s"] = 0.31
    assert RigConfig.build(values).sensor.type == "ros2"


def test_another_domain_is_another_address_but_another_topic_is_another_sensor():
    assert is_address("connection")
    assert not is_address("topic")


def test_the_installed_package_has_an_entry_point_for_its_type(monkeypatch):
    folder = ROOT / "examples/ros2_sensor"
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    (name, value), *others = project["entry-points"][GROUP].items()
    assert not others
    monkeypatch.syspath_prepend(folder)
    device = EntryPoint(name, value, GROUP).load()
    assert isinstance(device, ForceSensorType)
    assert device.config.build(VALUES).type == name


def test_the_readme_shows_a_sensor_that_its_type_takes():
    text = (ROOT / "examples/ros2_sensor/README.md").read_text()
    (shown,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    sensor = yaml.safe_load(shown)["sensor"]
    assert TopicSensorConfig.build(sensor).connection.network == sensor["connection"]["network"]
