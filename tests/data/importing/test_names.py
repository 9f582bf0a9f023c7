import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from softfin.data.importing.names import (
    COMMAND_WORDS,
    KINDS,
    NEUTRAL_WORDS,
    PHRASES,
    SPELLED,
    UNITS,
    read_name,
    split_unit,
)

CASES = {"lower": str.lower, "upper": str.upper, "title": str.title, "as it is": str}

SEPARATORS = (" ", "_", "-", ".", "/")

UNIT_STYLES = ("{} [{}]", "{}[{}]", "{} ({})", "{}({})", "{}_{}", "{} {}", "{}, {}", "{} / {}")


@st.composite
def meant(draw):
    """A name, and what it means by how it was made."""
    base = draw(st.sampled_from(sorted(PHRASES)))
    words = draw(st.permutations(draw(st.sampled_from(PHRASES[base])).split()))
    channel = base
    if base in ("angle", "velocity") and draw(st.booleans()):
        words = draw(st.permutations([*words, draw(st.sampled_from(sorted(COMMAND_WORDS)))]))
        channel = f"command_{base}"
    words = [*draw(st.lists(st.sampled_from(sorted(NEUTRAL_WORDS)), max_size=2)), *words]
    separator = draw(st.sampled_from(SEPARATORS))
    name = CASES[draw(st.sampled_from(sorted(CASES)))](separator.join(words))
    spelled = SPELLED[KINDS[channel]]
    text = draw(st.none() | st.sampled_from(sorted(spelled)))
    if text is None:
        return name, channel, None
    style = draw(st.sampled_from(UNIT_STYLES))
    unit = CASES[draw(st.sampled_from(["lower", "upper"]))](text)
    return style.format(name, unit), channel, spelled[text]


@given(meant())
def test_every_synonym_in_every_case_with_every_separator_and_unit_is_read_as_meant(case):
    name, channel, unit = case
    assert read_name(name) == (channel, unit)
    assert split_unit(name, KINDS[channel])[1] == unit


UNKNOWN_UNITS = "mm cm counts qc inc V mV % A Nm bar grad h hours -"


@given(st.sampled_from(sorted(PHRASES)), st.sampled_from(UNKNOWN_UNITS.split()))
def test_a_name_with_a_unit_that_is_not_known_is_not_read(channel, unit):
    assume(unit.lower() not in SPELLED[KINDS[channel]])
    assert read_name(f"{PHRASES[channel][0]} [{unit}]") is None


@given(st.text(max_size=30))
def test_any_text_is_read_or_not_but_never_fails(text):
    read = read_name(text)
    assert read is None or read[0] in KINDS


PEOPLE_WRITE = {
    ("angle", None): "position; ActualPosition; /fin/joint_states/fin/position; present_position",
    ("angle", "deg"): "theta_deg; theta(t) [deg]; Present Position [°]; AngleDeg",
    ("command_angle", None): "cmd_pos; targetAngle; desired position; cmd; Goal Position",
    ("command_angle", "deg"): "set_point [deg]",
    ("command_velocity", "rad/s"): "cmd_rad_s",
    ("command_velocity", "rpm"): "target_rpm; Moving Speed [rpm]",
    ("velocity", None): "speed; Present Speed; Present Velocity",
    ("velocity", "rad/s"): "vel [rad s^-1]; vel [rad·s⁻¹]; velRad_per_s",
    ("velocity", "deg/s"): "omega (deg per sec); ω [°/s]",
    ("force_x", None): "Fx; wrench.force.x",
    ("force_y", "N"): "force_y [N]",
    ("force_x", "mN"): "Force (x) [mN]; force_x_mN",
    ("time", "us"): "timestamp_us; time [µs]",
    ("time", "ms"): "t/ms; millis; timeMs",
    ("velocity", "rpm"): "dxl_present_velocity_rpm",
    ("command_velocity", None): "profile_velocity; goal_velocity; Profile Velocity",
    ("torque", "Nm"): "Tz [N.m]; torque_nm",
    ("torque", "mNm"): "motor torque (mNm)",
    ("current", "mA"): "MotorCurrent_mA",
    ("current", None): "present_current; Present Current",
}


@pytest.mark.parametrize(("channel", "unit"), PEOPLE_WRITE)
def test_names_as_people_write_them(channel, unit):
    names = PEOPLE_WRITE[channel, unit].split("; ")
    assert {read_name(name) for name in names} == {(channel, unit)}


NO_CHANNEL = (
    "; temperature; target_force_x; reference_x_n; reference; command id; pos_x; s; n; min; rad; tin; "
    "tread; step; command time; [deg]; current_position; goal current; present_load; realtime_tick; "
    "position_trajectory; profile_acceleration; present_position [pulse]"
)


@pytest.mark.parametrize("name", NO_CHANNEL.split("; "))
def test_what_is_no_channel_is_not_taken_for_one(name):
    assert read_name(name) is None


def test_the_factors_are_those_of_the_units():
    assert 180 * UNITS["angle"]["deg"] == pytest.approx(np.pi)
    assert 60 * UNITS["velocity"]["rpm"] == pytest.approx(UNITS["velocity"]["turn/s"])
    assert UNITS["force"]["lbf"] == pytest.approx(0.45359237 * UNITS["force"]["kgf"])
    assert all(next(iter(units.values())) == 1.0 for units in UNITS.values())


@given(
    st.sampled_from(sorted(PHRASES)),
    st.sampled_from(sorted(COMMAND_WORDS)),
    st.booleans(),
    st.data(),
)
def test_words_parted_by_capitals_are_told_apart(base, command, commanded, data):
    words = data.draw(st.sampled_from(PHRASES[base])).split()
    channel = base
    if commanded and base in ("angle", "velocity"):
        words = data.draw(st.permutations([*words, command]))
        channel = f"command_{base}"
    assume(all(len(word) > 1 for word in words))
    assert read_name("".join(map(str.title, words))) == (channel, None)
