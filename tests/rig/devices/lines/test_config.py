"""The file of a sensor that sends lines."""

import pytest

from softfin.core.errors import ConfigurationError
from softfin.rig.config import RigConfig
from softfin.rig.devices.lines.config import LinesConfig
from tests.rig.rigs import simulated

VALUES = {
    "columns": ["count", "force_x", "force_y"],
    "rate_hz": 320,
    "filter_delay_s": 0.01,
    "frame": "x,y",
    "port": "/dev/ttyACM0",
}


def test_a_serial_and_a_udp_sensor_are_accepted():
    assert LinesConfig.build(VALUES).counter == "count"
    udp = VALUES | {"port": None, "address": "192.168.1.9", "udp_port": 4747}
    assert LinesConfig.build(udp).udp_port == 4747


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"port": None}, "set either port, or both address and udp_port"),
        ({"udp_port": 4747, "address": "1.2.3.4"}, "set either port, or both address"),
        ({"columns": ["count", "force_x"]}, "columns must contain force_x and force_y"),
        ({"columns": ["force_x", "force_y", "force_x"]}, "each may appear only once"),
        ({"columns": ["force_x", "force_y", "count", "time_ms"]}, "only one of count, time_ms"),
        ({"columns": ["force_x", "thrust"]}, "columns.1 = 'thrust'"),
        ({"scale": {"force_z": 2.0}}, "scale.force_z: not a force or torque column"),
        ({"scale": {"force_x": 0.0}}, "scale must not be 0"),
        ({"rate_hz": 5}, "rate_hz = 5"),
        ({"rate_hz": 2000}, "rate_hz = 2000"),
        ({"filter_delay": 0.1}, "unknown key 'filter_delay'; did you mean 'filter_delay_s'"),
    ],
)
def test_a_file_that_cannot_be_meant_is_refused(changes, words):
    with pytest.raises(ConfigurationError, match=words.replace(".", r"\.")):
        LinesConfig.build(VALUES | changes)


@pytest.mark.parametrize(("rate_hz", "least"), [(10.0, "0.31"), (1000.0, "0.14")])
def test_a_limit_on_the_age_that_the_sensor_cannot_meet_is_refused(rate_hz, least):
    with simulated() as behind:
        values = behind.values(sensor=VALUES | {"type": "lines", "rate_hz": rate_hz})
    values["safety"]["force_stale_s"] = 0.05
    with pytest.raises(ConfigurationError, match=rf"use {least} or more, or a faster sensor"):
        RigConfig.build(values)
    values["safety"]["force_stale_s"] = float(least)
    assert RigConfig.build(values).sensor.type == "lines"
