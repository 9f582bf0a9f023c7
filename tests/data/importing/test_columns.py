import itertools
import shlex

import numpy as np
import pytest

from softfin.core.errors import ConfigurationError, LogError
from softfin.data.importing.columns import choose_columns, converted, describe_columns
from softfin.data.importing.importing import FORCE_FRAMES, ImportConfig, compose_frames
from softfin.data.importing.names import UNITS
from softfin.storage.log_file import SCHEMA

AUTHORS = ["command angle", "command velocity", "position", "force x", "force y"]
MAPPED = (
    "angle=position,command_angle=command angle,command_velocity=command "
    "velocity,force_x=force x,force_y=force y"
)


def chosen(names, source="x.csv", **options) -> dict[str, str]:
    found = choose_columns(names, ImportConfig.build({"rate_hz": 100} | options), source)
    return {channel: column.name for channel, column in found.items()}


def refusal(names, **options) -> str:
    with pytest.raises(LogError) as error:
        chosen(names, **options)
    message = str(error.value)
    assert message.isprintable()
    return message


def option_in(message: str) -> str:
    """The value of the option --columns that a message suggests, as a shell hands it on."""
    words = shlex.split(message[message.index("--columns ") :].split("; --velocity")[0])
    return words[1]


def test_softfins_own_names_need_no_mapping_and_no_note():
    found = choose_columns(SCHEMA.names, ImportConfig(), "log")
    assert {channel: column.name for channel, column in found.items()} == dict(
        zip(found, SCHEMA.names, strict=True)
    )
    assert describe_columns(found) == ""


def test_names_without_units_are_taken_as_si_and_shown():
    names = ["time", "command_angle", "command_velocity", "angle", "force_x", "force_y"]
    found = choose_columns(names, ImportConfig(), "log.csv")
    assert [column.name for column in found.values()] == list(found) == names
    assert "angle='angle' in rad (assumed), " in describe_columns(found)


def test_what_was_mapped_and_what_was_guessed_is_shown_with_its_unit():
    names = ["t [ms]", "cmd (deg)", "cmd vel", "blade, deg", "Fx [N]", "F_y_mN"]
    config = ImportConfig.build({"columns": '"angle=blade, deg"', "angles": "command_velocity=rpm"})
    found = choose_columns(names, config, "log.csv")
    assert describe_columns(found) == (
        "time='t [ms]' in ms, command_angle='cmd (deg)' in deg, command_velocity='cmd vel' in rpm, "
        "angle='blade, deg' in deg, force_x='Fx [N]' in N, force_y='F_y_mN' in mN"
    )


def test_softfins_own_name_counts_before_any_that_looks_like_it():
    assert chosen([*SCHEMA.names, "theta", "position"])["angle"] == "angle_rad"


def test_a_mapping_counts_before_softfins_own_names_and_before_guesses():
    assert chosen([*SCHEMA.names, "theta"], columns="angle=theta")["angle"] == "theta"
    assert chosen([*AUTHORS, "theta"], columns="angle=theta")["angle"] == "theta"


def test_the_control_table_of_a_dynamixel_is_read_and_shown():
    taken = {
        "time": "time",
        "command_angle": "goal_position",
        "command_velocity": "profile_velocity",
        "angle": "present_position",
        "velocity": "present_velocity",
        "force_x": "force_x",
        "force_y": "force_y",
    }
    names = [*taken.values(), "goal_velocity", "profile_acceleration", "position_trajectory"]
    found = choose_columns(names, ImportConfig(), "dynamixel.csv")
    assert {channel: column.name for channel, column in found.items()} == taken
    assert "angle='present_position' in rad (assumed)" in describe_columns(found)
    assert "or 'profile_speed'" in refusal([*names, "profile_speed"])


def test_the_zero_of_the_angle_is_in_the_unit_of_the_columns():
    channels = {"angle": np.array([100.0, 190.0]), "velocity": np.array([90.0])}
    config = ImportConfig.build({"angles": "deg", "angle_zero": 100, "negate": "angle"})
    result = converted(channels | {"command_angle": np.array([10.0])}, config)
    assert result["angle"] == pytest.approx([0.0, -np.pi / 2])
    assert result["command_angle"] == pytest.approx([-np.pi / 2])
    assert result["velocity"] == pytest.approx([-np.pi / 2])


def test_two_columns_that_may_be_the_same_channel_are_refused_with_the_option_that_decides():
    message = refusal([*AUTHORS, "theta [deg]"])
    assert message == (
        "x.csv: angle could be 'position' or 'theta [deg]'; choose one with --columns angle=position"
    )
    assert chosen([*AUTHORS, "theta [deg]"], columns=option_in(message))["angle"] == "position"
    message = refusal([*AUTHORS, "speed", "omega"])
    assert "velocity could be 'speed' or 'omega'" in message
    assert "velocity" not in chosen([*AUTHORS, "speed", "omega"], columns="velocity=-")


def test_a_channel_that_no_name_states_is_asked_for():
    names = ["blade angle", "command angle", "command velocity", "force x", "force y"]
    message = refusal(names)
    assert "no column recognized as angle among 'blade angle', 'command angle', " in message
    assert "map it with --columns angle=NAME" in message
    assert chosen(names, columns="angle=blade angle")["angle"] == "blade angle"


def test_a_suggestion_with_commas_and_quotes_can_be_copied():
    names = ["actual angle, (deg)", *AUTHORS]
    assert chosen(names, columns=option_in(refusal(names)))["angle"] == names[0]


@pytest.mark.parametrize("name", ["angle [counts]", "angle_counts", "position (m)", "theta [1/s]"])
def test_an_unknown_unit_is_refused_with_the_known_ones(name):
    names = [name, *AUTHORS[:2], *AUTHORS[3:]]
    for options in ({}, {"columns": f"angle={name}"}):
        message = refusal(names, **options)
        assert repr(name) in message
        assert all(unit in message for unit in UNITS["angle"])
    # A unit that is stated explicitly counts.
    assert chosen(names, columns=f"angle={name}", angles="deg")["angle"] == name


def test_a_readable_column_is_taken_where_another_has_an_unknown_unit():
    assert chosen([*AUTHORS, "position [counts]"])["angle"] == "position"


def test_a_told_unit_counts_before_the_names():
    names = ["t_ms", "cmd_deg", "cmd_vel_deg_s", "angle_deg", "Fx [mN]", "Fy [mN]"]
    config = ImportConfig.build(
        {"time_unit": "s", "angles": "angle=rad,command_velocity=deg", "force_unit": "N"}
    )
    found = choose_columns(names, config, "x.csv")
    assert [column.unit for column in found.values()] == ["s", "deg", "deg/s", "rad", "N", "N"]


def test_without_a_commanded_velocity_the_option_that_tells_it_is_named():
    names = ["time", "cmd", "angle", "velocity", "fx", "fy"]
    message = refusal(names)
    assert "no column recognized as command_velocity" in message
    assert "use --velocity 3.1 if all commands had that velocity" in message
    found = chosen(names, velocity_rad_s=3.1)
    assert "command_velocity" not in found
    assert found["velocity"] == "velocity"


def test_a_rate_and_a_velocity_that_are_told_keep_columns_from_being_guessed():
    names = ["time", *AUTHORS]
    assert "time" not in chosen(names)
    assert "command_velocity" not in chosen(names, velocity_rad_s=1.0)
    assert chosen(SCHEMA.names, velocity_rad_s=1.0)["time"] == "time_s"


def test_a_mapping_to_a_column_that_is_not_there_names_the_nearest():
    message = refusal(AUTHORS, columns=MAPPED.replace("=position", "=positon"))
    assert "did you mean 'position'" in message


def test_without_a_column_of_time_the_rate_must_be_told():
    assert "--rate" in refusal(AUTHORS, rate_hz=None)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("columns", "angel=position"),
        ("columns", "angle"),
        ("topics", "wrnch=/w"),
        ("angles", "grad"),
        ("angles", "angle=grad"),
        ("angles", "angle=rpm"),
        ("force_unit", "V"),
        ("negate", "force_x"),
        ("negate", "command_velocity"),
        ("force", "x,x"),
        ("angle_zero", "nan"),
    ],
)
def test_options_that_cannot_be_are_refused_by_name(option, value):
    with pytest.raises(ConfigurationError, match=option):
        ImportConfig.build({option: value})


def test_degrees_signs_and_axes_are_converted():
    one = np.array([1.0, 2.0])
    channels = dict.fromkeys(
        ("angle", "velocity", "command_angle", "command_velocity"), np.degrees(one)
    )
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
    once = converted(channels, ImportConfig(force=compose_frames(given, then)))
    assert {name: float(value[0]) for name, value in once.items()} == {
        k: float(v[0]) for k, v in twice.items()
    }
