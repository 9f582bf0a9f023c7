import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.tank import TankConfig
from softfin.tank.calibration.config import (
    CALIBRATE_PRESETS,
    FREE,
    CalibrateConfig,
    Parameter,
    RecordingConfig,
    every_range,
    list_parameters,
)
from softfin.tank.calibration.model import Space


def space(**ranges):
    names = {name.replace("__", "."): limits for name, limits in ranges.items()}
    return Space(
        [Parameter(name, *limits) for name, limits in names.items()],
        TankConfig(),
        RecordingConfig(),
    )


@given(
    st.floats(0, 1),
    st.sampled_from([("fin.length_m", 0.1, 0.4), ("recording.angle_offset_rad", -0.2, 0.3)]),
)
def test_scaled_coordinates_and_values_are_inverse(at, limits):
    parameter = Parameter(*limits)
    assert parameter.scaled(parameter.value(at)) == pytest.approx(at, abs=1e-9)
    assert parameter.low - 1e-9 <= parameter.value(at) <= parameter.high + 1e-9


@pytest.mark.parametrize(
    "limits", [("fin.length_m", 0.1, 0.4), ("recording.angle_offset_rad", -0.2, 0.3)]
)
def test_the_slope_is_that_of_the_value(limits):
    parameter = Parameter(*limits)
    rise = parameter.value(0.3 + 1e-5) - parameter.value(0.3 - 1e-5)
    assert parameter.slope(0.3) == pytest.approx(rise / 2e-5, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("fin.length_m", "m"),
        ("drive.acceleration_rad_s2", "rad/s2"),
        ("drive.stiffness_nm_rad", "N m/rad"),
        ("recording.velocity_limit_rad_s", "rad/s"),
        ("water.drag_coefficient", "-"),
        ("fin.density_kg_m3", "kg/m3"),
    ],
)
def test_units_come_from_names(name, unit):
    assert Parameter(name, 0.1, 1.0).unit == unit


def test_all_that_is_free_by_default_exists_and_starts_within_its_range():
    for config in CALIBRATE_PRESETS.values():
        found = list_parameters(config.parameters)
        assert found
        assert (Space(found, config.tank, config.recording).start >= 0).all()
    assert {
        parameter.name for parameter in list_parameters(CALIBRATE_PRESETS["full"].parameters)
    } == set(FREE)


def test_a_point_becomes_a_tank_and_a_recording():
    here = space(fin__length_m=(0.1, 0.4), recording__angle_gain=(0.5, 2.0))
    tank, recording = here.configs(np.array([1.0, 0.5]))
    assert tank.fin.length_m == pytest.approx(0.4)
    assert recording.angle_gain == pytest.approx(1.0)
    assert tank.fin.span_m == TankConfig().fin.span_m


def test_parameters_are_freed_or_fixed_by_a_file_or_by_options():
    merged = CalibrateConfig().merged(
        {"parameters": {"fin": {"span_m": [0.05, 0.2], "length_m": None}}}, "file"
    )
    names = {parameter.name for parameter in list_parameters(merged.parameters)}
    assert "fin.span_m" in names
    assert "fin.length_m" not in names
    changed = CalibrateConfig().changed(
        ["parameters.fin.density_kg_m3=[900, 1300]", "parameters.drive.lag_s=null"]
    )
    names = {parameter.name for parameter in list_parameters(changed.parameters)}
    assert "fin.density_kg_m3" in names
    assert "drive.lag_s" not in names


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        (
            {"fin": {"lenght_m": (0.1, 0.4)}},
            "unknown parameter 'fin.lenght_m'; did you mean 'fin.length_m'?",
        ),
        ({"sail": {"area": (0.1, 0.4)}}, "unknown parameter 'sail.area'; did you mean '"),
        (
            {"fin": {"length_m": (0.4, 0.1)}},
            r"parameters.fin.length_m = \[0.4, 0.1\]: use \[low, high\]",
        ),
    ],
)
def test_an_unknown_parameter_or_a_range_out_of_order_is_refused(ranges, message):
    config = CalibrateConfig(parameters=ranges)
    with pytest.raises(ConfigurationError, match=message):
        list_parameters(config.parameters)


def test_a_range_without_its_start_is_refused_and_says_what_to_set():
    with pytest.raises(
        ConfigurationError,
        match=r"initial value tank.fin.length_m = 0.\d+ is outside this range; widen",
    ):
        space(fin__length_m=(1.0, 2.0))


def test_a_range_beyond_what_a_tank_may_be_is_refused():
    with pytest.raises(
        ConfigurationError, match=r"parameters.drive.dead_time_s: drive.dead_time_s = 5.0"
    ):
        space(drive__dead_time_s=(0.0, 5.0))


def test_every_number_of_tank_and_recording_may_be_freed():
    known = every_range({})
    assert set(known) == {"drive", "fin", "water", "sensor", "recording"}
    assert "plates" not in known["fin"]
    assert all(limits is None for names in known.values() for limits in names.values())
