"""Configuration of a Dynamixel, and its units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.dynamixel import CENTER, TICKS_PER_TURN
from softfin.core.errors import ConfigurationError
from softfin.rig.devices.dynamixel.config import DynamixelConfig, Units, position_range
from tests.rig.devices.dynamixel.bench import servo_config

VALUES = {
    "port": "/dev/ttyUSB0",
    "model": "XM430-W350",
    "id": 1,
    "acceleration_rad_s2": 30.0,
    "quick_stop_rad_s2": 60.0,
}


def test_values_that_must_not_be_guessed_have_no_default():
    for name in VALUES:
        with pytest.raises(ConfigurationError, match=name):
            DynamixelConfig.build({key: VALUES[key] for key in VALUES if key != name})
    config = DynamixelConfig.build(VALUES)
    assert config.summary == "XM430-W350, ID 1"
    assert not config.NEEDS_BUS
    assert config.host is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "AX-12A"}, "XM430-W350"),
        ({"id": 254}, "id"),
        ({"baud": 57600}, "baud"),
        ({"heartbeat_s": 0.05}, "heartbeat_s"),
        ({"quick_stop_rad_s2": 20.0}, "below acceleration_rad_s2"),
        ({"quick_stop_rad_s2": 1.0, "acceleration_rad_s2": 1.0}, r"use 6\.3 or more"),
        ({"slowest_rad_s": 0.01}, "slowest_rad_s 0.01 rounds to 0"),
        ({"acceleration_rad_s2": 0.1}, "acceleration_rad_s2 0.1 is outside the servo range"),
        ({"quick_stop_rad_s2": 20_000.0}, "quick_stop_rad_s2 20000 is outside"),
        ({"angle_max_rad": 3.0}, "must be within 2.99 rad of zero"),
        ({"prot": "x"}, "port"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_reason(changes, words):
    with pytest.raises(ConfigurationError, match=words):
        DynamixelConfig.build(VALUES | changes)


@pytest.mark.parametrize(("heartbeat_s", "units"), [(0.1, 4), (0.119, 4), (0.12, 5), (1.0, 49)])
def test_the_watchdog_acts_in_time(heartbeat_s, units):
    assert servo_config(heartbeat_s=heartbeat_s).watchdog == units


@pytest.mark.parametrize("direction", [1, -1])
@given(st.floats(-math.pi / 2, math.pi / 2))
def test_an_angle_comes_back_from_the_servo(direction, angle):
    units = Units.of(servo_config(direction=direction))
    assert units.angle(units.position(angle)) == pytest.approx(
        angle, abs=math.pi / TICKS_PER_TURN + 1e-9
    )


def test_units_are_those_of_the_manual():
    units = Units.of(servo_config(direction=-1))
    # A quarter turn; 0.229 rev/min per unit of velocity, 214.577 rev/min2 of acceleration.
    assert units.position(-math.pi / 2) == CENTER + TICKS_PER_TURN // 4
    assert units.velocity(100) == pytest.approx(-22.9 * 2 * math.pi / 60)
    assert units.speed(22.9 * 2 * math.pi / 60) == 100
    assert units.acceleration(100 * 214.577 * 2 * math.pi / 3600) == 100
    assert units.current(1000) == pytest.approx(-2.69)


def test_the_range_is_ordered_in_both_directions():
    for direction in (1, -1):
        config = servo_config(angle_min_rad=-1.0, angle_max_rad=0.5, direction=direction)
        lowest, highest = position_range(config)
        assert lowest < CENTER < highest
        assert highest - lowest == pytest.approx(1.5 * TICKS_PER_TURN / (2 * math.pi), abs=1)
