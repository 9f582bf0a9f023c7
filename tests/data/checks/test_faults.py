"""Faults of logs of three fins: the issue that each makes, and what its fix says."""

import numpy as np
import pytest

from softfin.data.checks.inspection import inspect
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import Issue
from tests.data.faulty import (
    FAULTS,
    FORCES,
    Columns,
    Fault,
    cut,
    late,
    late_at_times,
    log_of,
    named,
    shifted,
    slower_loop,
    tank_logs,
    times,
    to_columns,
    turned,
)


def found(*logs: Columns, config: ImportConfig | None = None) -> dict[str, Issue]:
    inspection = inspect(named(*map(log_of, logs), test=0), config=config)
    return {one.name: one for one in inspection.issues if one.name != "no test logs"}


def faulty(fault: Fault, fin: str = "tank", index: int = 0) -> Columns:
    columns = to_columns(tank_logs(index + 1, fin)[index])
    fault(columns)
    return columns


EXPECTED = {
    "turned by 20 degrees": ("error", "turned force", "a = -2"),
    "turned by -30 degrees": ("error", "turned force", "degrees"),
    "turned by 45 degrees": ("error", "turned force", ""),
    "turned with the shaft": ("error", "shaft frame", "fix the sensor"),
    "drift": ("warning", "force drift", "subtract the drift"),
    "low-pass of 2 Hz": ("warning", "filtered force", "switch off"),
    "low-pass in both directions": ("warning", "filtered force", "switch off"),
    "sensor at 10 Hz": ("warning", "repeated values", "100 Hz"),
    "clipped": ("warning", "saturated", "larger range"),
    "frozen": ("error", "stuck", "remove these rows"),
    "single samples": ("error", "spikes", "repair"),
    "force 300 ms late": ("error", "force clock", "synchronize"),
    "force 3 s early": ("error", "force clock", "synchronize"),
    "force late at times": ("error", "changing lag", "synchronize"),
    "force in counts": ("error", "force size", "N"),
    "velocity in rpm": ("error", "velocity unit", "velocity=rpm"),
    "velocity in degrees": ("error", "velocity unit", "velocity=deg"),
    "clock": ("warning", "velocity unit", "check the clock"),
    "command in rpm": ("error", "command velocity unit", "--angles command_velocity=rpm"),
    "command in degrees": ("error", "command velocity unit", "--angles command_velocity=deg"),
    "command read as degrees": ("error", "command velocity unit", "--angles command_velocity=rad"),
    "command in registers": (
        "error",
        "command velocity unit",
        "--angles command_velocity=dynamixel",
    ),
    "10-bit counts": ("warning", "speed", "1,023"),
    "repeated rows": ("note", "repeated values", "once per row"),
}
"""Severity and name of the issue, and a part of its fix."""


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
@pytest.mark.parametrize("fault", EXPECTED)
def test_each_fault_is_found_with_its_severity_and_fix(fault, fin):
    severity, name, fix = EXPECTED[fault]
    # The unit with which the file was read.
    angles = {"command_velocity": "deg"} if fault == "command read as degrees" else {}
    issue = found(faulty(FAULTS[fault], fin), config=ImportConfig(angles=angles))[name]
    assert issue.severity == severity
    assert fix in issue.fix


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
def test_nothing_is_wrong_with_good_logs_of_three_fins(fin):
    columns = [to_columns(log) for log in tank_logs(5, fin)]
    assert not found(*columns)
    assert not found(*(to_columns(cut(log, 1000, 2500)) for log in tank_logs(5, fin)[:2]))


ONLY_A_CLOCK = ("force axes", "turned force", "shaft frame", "force lag")


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
@pytest.mark.parametrize("ticks", [30, 60, -120, 320])
def test_a_clock_that_is_off_gets_no_advice_about_axes_or_lags(ticks, fin):
    issues = found(faulty(late(ticks), fin))
    assert not set(ONLY_A_CLOCK) & issues.keys()
    assert "--" not in issues["force clock"].fix
    assert f"{ticks / 100 + 0.02:.1f} s" in issues["force clock"].message


def test_times_of_late_stretches_are_told():
    issue = found(faulty(late_at_times))["changing lag"]
    assert "the 6 s from 12, 42 s" in issue.message


@pytest.mark.parametrize("degrees", [90, 180])
def test_the_zero_of_the_angle_comes_before_the_axes(degrees):
    # Servos are often at 90 degrees in their centre.
    issues = found(faulty(shifted(degrees)))
    assert issues["angle zero"].severity == "error"
    assert issues["angle zero"].fix.endswith(f"--angle-zero={np.radians(degrees):.4g}")
    assert "force axes" not in issues


def test_an_angle_zero_that_was_set_is_believed_and_goes_on_from_there():
    # A quarter turn of the force that a fin with only positive angles may have.
    config = ImportConfig(angles={"angle": "rad"}, angle_zero=0.5)
    fix = found(faulty(shifted(90)), config=config)["force axes"].fix
    assert fix.startswith("--force=y,-x")
    assert "--angle-zero=2.071" in fix


def test_an_angle_zero_off_by_20_degrees_and_a_turned_sensor_are_both_listed():
    fix = found(faulty(shifted(20)))["turned force"].fix
    assert "by a = -20 degrees" in fix
    assert "--angle-zero=0.3491" in fix


@pytest.mark.parametrize(
    ("quarters", "frame", "zero"), [(1, "y,-x", 90), (2, "-x,-y", -180), (3, "-y,x", -90)]
)
def test_axes_and_angle_zero_explain_a_quarter_turn_equally(quarters, frame, zero):
    fix = found(faulty(turned(90 * quarters)))["force axes"].fix
    assert fix.startswith(f"--force={frame};")
    assert f"at {-zero} degrees where the log has 0" in fix
    assert f"--angle-zero={np.radians(zero):.4g}" in fix
    # That is so: the other reading makes the log good, but for the range of the commands.
    assert "force axes" not in found(
        faulty(lambda log: (turned(90 * quarters)(log), shifted(-zero)(log)))
    )


def test_a_mirrored_sensor_and_mirrored_angles_are_both_listed():
    fix = found(faulty(times("force_y_n", -1)))["force axes"].fix
    assert fix.startswith("--force=x,-y;")
    assert "--negate command_angle,angle" in fix


def test_a_clock_that_is_off_shows_in_the_speed_as_well():
    issues = found(faulty(slower_loop))
    assert issues["speed"].severity == "warning"
    assert "1.25 times" in issues["speed"].message


def test_following_the_advice_never_hides_a_fault():
    """Of a loop that is slower than its stamps, with the velocity derived from the angle."""
    columns = faulty(slower_loop)
    columns["velocity_rad_s"] = np.gradient(columns["angle_rad"], 0.01)
    issues = found(columns)
    assert issues.keys() == {"speed"}
    # A factor of the commanded velocity would hide it.
    assert "multipl" not in issues["speed"].fix


def test_a_unit_is_added_to_those_that_were_given():
    config = ImportConfig(angles={"velocity": "deg"})
    columns = faulty(times("command_velocity_rad_s", 9.549))
    fix = found(columns, config=config)["command velocity unit"].fix
    assert fix == "--angles velocity=deg,command_velocity=rpm"


def test_advice_leads_the_log_of_a_servo_with_its_centre_at_90_degrees_to_its_true_axes():
    columns = faulty(shifted(90))
    mirror = times("force_y_n", -1)
    mirror(columns)
    assert found(columns).keys() == {"angle zero", "no rest"}
    shifted(-90)(columns)
    issues = found(columns)
    assert issues.keys() == {"force axes"}
    assert issues["force axes"].fix.startswith("--force=x,-y;")
    mirror(columns)
    assert not found(columns)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_millinewtons_or_kilonewtons_show_in_the_size_of_a_fin(factor):
    """Of a fin of half a metre or of 10 cm; a fin of usual size hides either."""
    fin = "vehicle" if factor > 1 else "hand"
    columns = faulty(lambda log: None, fin)
    for name in FORCES:
        times(name, factor)(columns)
    assert "--force-unit" in found(columns)["force size"].fix


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
def test_an_angle_is_compared_with_its_command_at_rest(fin):
    def turn(log: Columns) -> None:
        log["angle_rad"] = log["angle_rad"] + np.radians(15)

    issue = found(faulty(turn, fin))["rest angle"]
    assert issue.message == "at rest, the angle is +15 degrees from its command"
    issue = found(faulty(times("command_angle_rad", np.pi / 180), fin))["rest angle"]
    assert "57" in issue.message


def test_a_frozen_command_is_stuck():
    def freeze(log: Columns) -> None:
        log["command_angle_rad"][1000:3000] = log["command_angle_rad"][1000]

    assert found(faulty(freeze))["stuck"].column == "command_angle"


def test_a_force_clock_that_runs_fast_gets_no_lag():
    def fast(log: Columns) -> None:
        rows = np.arange(len(log["angle_rad"]))
        for name in FORCES:
            log[name] = np.interp(0.998 * rows, rows, log[name])

    issues = found(faulty(fast))
    assert issues["changing lag"].severity == "error"
    assert "force lag" not in issues


def test_axes_with_different_lags_are_told():
    def of_y(log: Columns) -> None:
        log["force_y_n"] = np.roll(log["force_y_n"], 15)

    issues = found(faulty(of_y))
    assert "20 ms, and force_y by 170 ms" in issues["force clock"].message
    assert "force lag" not in issues


def test_a_force_in_the_frame_of_a_reversed_shaft_gets_its_formula():
    def turn(log: Columns) -> None:
        force = (log["force_x_n"] + 1j * log["force_y_n"]) * np.exp(-1j * log["angle_rad"])
        log["force_x_n"] = force.real
        log["force_y_n"] = force.imag

    assert "x cos(a) - y sin(a), y cos(a) + x sin(a)" in found(faulty(turn))["shaft frame"].fix


def test_drift_is_found_in_a_short_log():
    columns = to_columns(cut(tank_logs(1, "tank")[0], 1000, 2500))
    columns["force_x_n"] = columns["force_x_n"] + np.linspace(0, 8, 1500)
    assert found(columns)["force drift"].column == "force_x"


def test_degrees_that_are_radians_are_told():
    def shrink(log: Columns) -> None:
        for name in ("angle_rad", "command_angle_rad", "velocity_rad_s", "command_velocity_rad_s"):
            log[name] = np.radians(log[name])

    config = ImportConfig(angles=dict.fromkeys(("angle", "command_angle"), "deg"))
    assert found(faulty(shrink), config=config)["radians"].fix == "--angles rad"


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
def test_angles_that_are_too_small_get_no_advice_about_a_shaft_frame(fin):
    assert "shaft frame" not in found(faulty(FAULTS["10-bit counts"], fin))
