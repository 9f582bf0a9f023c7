import itertools

import numpy as np
import pytest

from softfin.errors import ConfigurationError, LogError
from softfin.logs.columns import channels_of, converted, looks_like, suggestion
from softfin.logs.importing import FORCE_FRAMES, ImportConfig, composed
from softfin.logs.parquet import SCHEMA

AUTHORS = ["command angle", "command velocity", "position", "force x", "force y"]
MAPPED = "angle=position,command_angle=command angle,command_velocity=command velocity,force_x=force x,force_y=force y"


def test_softfins_own_names_need_no_mapping():
    found = channels_of(SCHEMA.names, ImportConfig(), "log")
    assert found["angle"] == "angle_rad"
    assert found["time"] == "time_s"
    assert len(found) == 7


def test_names_are_never_guessed_but_suggested_so_that_they_can_be_copied():
    with pytest.raises(LogError) as error:
        channels_of(AUTHORS, ImportConfig(rate_hz=100), "final.csv")
    message = str(error.value)
    assert "final.csv: which column is command_angle?" in message
    option = message.split("--columns ")[1].strip("'")
    found = channels_of(AUTHORS, ImportConfig.build({"columns": option, "rate_hz": 100}), "final.csv")
    assert found == ImportConfig.build({"columns": MAPPED}).columns


def test_what_no_name_suggests_is_left_to_fill_in():
    assert "angle=NAME" in suggestion(["a", "b", "force x"])
    assert "force_x='force x'" not in suggestion(["force x"])
    assert suggestion(["Fx", "Fy"], {"angle": "p", "command_angle": "q", "command_velocity": "r"}) == (
        "--columns force_x=Fx,force_y=Fy"
    )


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("position", "angle"), ("ActualPosition", "angle"), ("theta_deg", "angle"), ("pos", "angle"),
        ("cmd_pos", "command_angle"), ("targetAngle", "command_angle"), ("desired position", "command_angle"),
        ("speed", "velocity"), ("command_vel", "command_velocity"), ("Fx", "force_x"), ("force_y [N]", "force_y"),
        ("Force X", "force_x"), ("timestamp", "time"), ("t", "time"), ("temperature", None), ("Fz", None), ("", None),
        ("torque_x", None),
    ],
)  # fmt: skip
def test_obvious_names_are_recognised_and_others_are_not(name, channel):
    assert looks_like(name) == channel


def test_a_mapping_to_a_column_that_is_not_there_names_the_nearest():
    with pytest.raises(LogError, match="did you mean 'position'"):
        channels_of(AUTHORS, ImportConfig.build({"columns": MAPPED.replace("=position", "=positon")}), "x.csv")


def test_without_a_column_of_time_the_rate_must_be_told():
    with pytest.raises(LogError, match="give --rate 100"):
        channels_of(AUTHORS, ImportConfig.build({"columns": MAPPED}), "x.csv")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"columns": "angel=position"}, "did you mean 'angle'"),
        ({"columns": "angle"}, "write NAME=VALUE"),
        ({"topics": "wrnch=/w"}, "did you mean 'wrench'"),
        ({"angles": "grad"}, "'grad' is no unit of angles; say rad or deg"),
        ({"angles": "angle=grad"}, "'rad' or 'deg'"),
        ({"negate": "force_x"}, "force_x"),
        ({"force": "x,x"}, "force"),
        ({"rate_hz": 0}, "greater than 0"),
    ],
)
def test_options_that_cannot_be_are_refused_in_a_line(option, message):
    with pytest.raises(ConfigurationError, match=message):
        ImportConfig.build(option)


def test_degrees_signs_and_axes_are_converted():
    one = np.array([1.0, 2.0])
    channels = dict.fromkeys(("angle", "velocity", "command_angle", "command_velocity"), np.degrees(one))
    channels |= {"force_x": one, "force_y": 10 * one}
    config = ImportConfig.build({"angles": "deg", "negate": "angle,command_angle", "force": "y,-x"})
    result = converted(channels, config)
    np.testing.assert_allclose(result["angle"], -one)
    np.testing.assert_allclose(result["velocity"], -one)
    np.testing.assert_allclose(result["command_angle"], -one)
    np.testing.assert_allclose(result["command_velocity"], one)
    np.testing.assert_allclose(result["force_x"], 10 * one)
    np.testing.assert_allclose(result["force_y"], -one)


def test_units_can_be_told_one_by_one():
    channels = {"angle": np.array([180.0]), "command_angle": np.array([1.0])}
    result = converted(channels, ImportConfig.build({"angles": "angle=deg"}))
    assert result["angle"][0] == pytest.approx(np.pi)
    assert result["command_angle"][0] == 1.0


@pytest.mark.parametrize(("given", "then"), list(itertools.product(FORCE_FRAMES, FORCE_FRAMES)))
def test_two_frames_one_after_the_other_are_one(given, then):
    channels = {"force_x": np.array([2.0]), "force_y": np.array([3.0])}
    twice = converted(converted(channels, ImportConfig(force=given)), ImportConfig(force=then))
    once = converted(channels, ImportConfig(force=composed(given, then)))
    assert {name: float(value[0]) for name, value in once.items()} == {k: float(v[0]) for k, v in twice.items()}
