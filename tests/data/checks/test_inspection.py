from collections.abc import Callable

import numpy as np
import pytest
from examples.import_keras import read_keras_surrogate

from softfin.data.checks.inspection import Inspection, inspect
from softfin.data.importing.importing import ImportConfig
from softfin.tank import IDEAL, Tank, TankConfig
from tests.data.faulty import (
    ROWS,
    Columns,
    cut,
    delayed,
    log_of,
    named,
    recorded,
    tank_logs,
    to_columns,
)


def inspected(change=None, config: ImportConfig | None = None) -> Inspection:
    logs = tank_logs(2)
    if change is not None:
        columns = [to_columns(log) for log in logs]
        for one in columns:
            change(one)
        logs = [log_of(one) for one in columns]
    return inspect(named(*logs), config=config)


def grave(inspection: Inspection) -> dict[str, str]:
    """Names of errors and warnings, with their fixes."""
    return {one.name: one.fix for one in inspection.issues if one.severity != "note"}


def message(inspection: Inspection, name: str) -> str:
    return next(one.message for one in inspection.issues if one.name == name)


def test_nothing_is_wrong_with_logs_of_the_virtual_tank():
    inspection = inspected()
    assert inspection.issues == []
    summary = inspection.summary()
    assert 20 < summary["command_lag_ms"]["median"] < 45
    assert 10 < summary["force_lag_ms"]["median"] < 35
    assert summary["frames"]["x,y"] > 0.85


def test_nothing_is_wrong_with_short_logs_of_the_virtual_tank():
    assert not grave(
        inspect(named(*(cut(log, k, k + 700) for log in tank_logs(5) for k in (0, 700))))
    )


def test_nothing_is_wrong_with_logs_of_an_ideal_tank_whose_readings_stand_still_at_rest():
    ideal = Tank(TankConfig(sensor=IDEAL))
    # As many and as long as those of the default tank, whose program this is; half of two are
    # inspected.
    logs = [cut(log, 0, 3000) for log in recorded(ideal, 5, ROWS)[:2]]
    assert not grave(inspect(named(*logs)))


@pytest.fixture(scope="module")
def published_logs(published):
    fin = read_keras_surrogate(
        published / "cnn_pos_net.keras",
        published / "lstm_force_net.keras",
        published / "scalers.json",
    )
    return recorded(fin, 2, 6000)


def test_logs_of_the_published_fin_are_good_but_faster_than_their_commands(published_logs):
    inspection = inspect(named(*published_logs))
    assert grave(inspection).keys() == {"speed"}
    assert all(3.5 < one.speed_ratio < 7 for one in inspection.logs)


@pytest.mark.parametrize("ticks", [5, -8])
def test_a_lagging_force_is_found_in_the_published_fin_too(published_logs, ticks):
    columns = [to_columns(log) for log in published_logs]
    for one in columns:
        late(ticks, *FORCES)(one)
    assert "force lag" in grave(inspect(named(*map(log_of, columns))))


FORCES = ("force_x_n", "force_y_n")
COMMANDS = ("command_angle_rad", "command_velocity_rad_s")
ANGLES = ("angle_rad", "velocity_rad_s")

Fault = Callable[[Columns], None]


def times(factor: float, *names: str) -> Fault:
    def fault(columns: Columns) -> None:
        for name in names:
            columns[name] *= factor

    return fault


def plus(distance: float, *names: str, rows: object = slice(None)) -> Fault:
    def fault(columns: Columns) -> None:
        for name in names:
            columns[name][rows] += distance

    return fault


def late(ticks: int, *names: str) -> Fault:
    def fault(columns: Columns) -> None:
        for name in names:
            columns[name] = delayed(columns[name], ticks)

    return fault


def always(value: float | None, name: str, rows: slice = slice(None)) -> Fault:
    """Without a value, it is that of the first of the rows."""

    def fault(columns: Columns) -> None:
        columns[name][rows] = columns[name][rows][0] if value is None else value

    return fault


def swap(columns: Columns) -> None:
    columns["force_x_n"], columns["force_y_n"] = columns["force_y_n"], columns["force_x_n"]


def turn(columns: Columns) -> None:
    columns["force_x_n"], columns["force_y_n"] = columns["force_y_n"], -columns["force_x_n"]


def clipped(columns: Columns) -> None:
    columns["force_y_n"] = np.clip(columns["force_y_n"], -4, 4)


def velocity_of_something(columns: Columns) -> None:
    columns["velocity_rad_s"] = columns["force_x_n"].copy()


def seam(columns: Columns) -> None:
    columns["angle_rad"][3000:3300] += 2.5


def counts(columns: Columns) -> None:
    for name in ("angle_rad", "command_angle_rad"):
        columns[name] = np.round(2048 + columns[name] * 4096 / (2 * np.pi))
    for name in ("velocity_rad_s", "command_velocity_rad_s"):
        columns[name] = np.round(columns[name] / 0.024)


DEGREES = 180 / np.pi
degrees = times(DEGREES, *ANGLES, *COMMANDS)
late_force = late(5, *FORCES)
late_command = late(5, *COMMANDS)
mirrored_command = times(-1, "command_angle_rad")
spikes = plus(30, "force_x_n", rows=[500, 1500, 2500])
stuck_force = always(None, "force_y_n", slice(1000, 1400))
offset = plus(0.8, "force_x_n")
still_velocity = always(0, "velocity_rad_s")

ALONE = {
    "swapped forces": (swap, "force axes", "--force=y,x"),
    "mirrored x": (times(-1, "force_x_n"), "force axes", "--force=-x,y"),
    "mirrored y": (times(-1, "force_y_n"), "force axes", "--force=x,-y"),
    "turned force": (turn, "force axes", "--force=-y,x"),
    "degrees": (degrees, "degrees", "--angles deg"),
    "late force": (late_force, "force lag", "--force-lag 40"),
    "late command": (late_command, "command lag", "--command-lag 50"),
    "mirrored command": (mirrored_command, "command sign", "--negate command_angle"),
    "mirrored angle": (times(-1, *ANGLES), "command sign", "--negate angle"),
    "spikes": (spikes, "spikes", "repair"),
    "many spikes": (plus(-40, "force_y_n", rows=slice(100, 4000, 50)), "spikes", "repair"),
    "clipped": (clipped, "saturated", "select a larger range"),
    "mirrored velocity": (times(-1, "velocity_rad_s"), "velocity sign", "--negate velocity"),
    "offset": (offset, "force offset", "tare"),
    "still velocity": (still_velocity, "constant velocity", "--columns velocity=-"),
    "counts": (counts, "counts", "--angles dynamixel --angle-zero 2048"),
}
"""Faults, each with the name of the only issue that it makes, and a part of its fix."""

NOT_ALONE = {
    "angle in degrees": (times(DEGREES, *ANGLES), "degrees", "--angles angle=deg,velocity=deg"),
    "command in degrees": (
        times(DEGREES, "command_angle_rad"),
        "degrees",
        "--angles command_angle=deg",
    ),
    "early force": (late(-5, *FORCES), "force lag", "--force-lag -60"),
    "early command": (late(-10, *COMMANDS), "command lag", "--command-lag -100"),
    "one command": (always(0.5, "command_angle_rad"), "constant command", "map the column"),
    "other command": (late(3000, "command_angle_rad"), "not following", "map other columns"),
    "stuck force": (stuck_force, "stuck", "remove these rows"),
    "dead force": (always(0, "force_x_n"), "stuck", "remove these rows"),
    "stuck angle": (always(None, "angle_rad", slice(2000, 2500)), "stuck", "remove these rows"),
    "other unit": (times(DEGREES / 3, "velocity_rad_s"), "velocity unit", "velocity unit"),
    "other velocity": (velocity_of_something, "velocity", "map a different column"),
    "seam": (seam, "jumps", "--rows-per-log"),
    "no velocity": (always(0, "command_velocity_rad_s"), "command velocity", "map the column"),
    "far": (plus(1.8, "angle_rad", "command_angle_rad"), "angle zero", "--angle-zero=1.833"),
}


@pytest.mark.parametrize("fault", [*ALONE, *NOT_ALONE])
def test_each_fault_is_found_by_name_with_its_fix(fault):
    change, name, fix = (ALONE | NOT_ALONE)[fault]
    found = grave(inspected(change))
    assert fix in found[name]
    assert fault in NOT_ALONE or len(found) == 1


def test_a_velocity_that_was_told_is_not_taken_for_degrees():
    def change(columns: Columns) -> None:
        for name in ("command_angle_rad", "angle_rad", "velocity_rad_s"):
            columns[name] = np.degrees(columns[name])
        columns["command_velocity_rad_s"][:] = 3.1

    told = inspected(change, ImportConfig(velocity_rad_s=3.1)).issues[0]
    assert told.fix == "--angles command_angle=deg,angle=deg,velocity=deg"


def test_a_velocity_in_degrees_is_told_by_the_speed_of_the_fin():
    def change(columns: Columns) -> None:
        for name in ("command_angle_rad", "angle_rad", "velocity_rad_s"):
            columns[name] = np.degrees(columns[name])

    rad_s = "--angles command_angle=deg,angle=deg,velocity=deg"
    assert inspected(change).issues[0].fix == rad_s
    assert inspected(degrees).issues[0].fix == "--angles deg"


def test_short_logs_are_checked_together():
    columns = [to_columns(cut(log, 0, 800)) for log in tank_logs(4)]
    for one in columns:
        mirrored_command(one)
    inspection = inspect(named(*map(log_of, columns)))
    assert grave(inspection)["command sign"] == "--negate command_angle"
    assert (
        next(one.log for one in inspection.issues if one.name == "command sign")
        == "the first 4 logs together"
    )


def test_a_velocity_of_zeros_is_an_error_in_one_log_of_several_and_not_on_a_fin_at_rest():
    faulty, still = (to_columns(log) for log in tank_logs(2))
    still_velocity(faulty)
    issue = next(
        one for one in inspect(named(*tank_logs(2), log_of(faulty))).issues if one.name != "columns"
    )
    assert (issue.severity, issue.name, issue.logs) == ("error", "constant velocity", ("test/2",))
    for name in ("angle_rad", "command_angle_rad"):
        still[name][:] = 0
    # One wrong sample does not make it move.
    still["angle_rad"][3000] = 0.3
    still_velocity(still)
    assert "constant velocity" not in grave(inspect(named(*tank_logs(2), log_of(still))))


def test_whole_degrees_are_not_taken_for_counts_but_may_be_some():
    def change(columns: Columns) -> None:
        degrees(columns)
        for name in ("command_angle_rad", "angle_rad", "velocity_rad_s", "command_velocity_rad_s"):
            columns[name] = np.round(columns[name])

    fix = grave(inspected(change))["degrees"]
    assert fix.startswith("--angles deg; if these integers are encoder counts instead, ")


def test_messages_hold_the_numbers():
    assert "angle ranges from -8" in message(inspected(degrees), "degrees")
    assert message(inspected(late_force), "force lag").startswith("7")
    assert message(inspected(late_command), "command lag").startswith("-19 ms from command")
    assert "correlation with the force of a model fin 0.0" in message(inspected(swap), "force axes")
    assert message(inspected(spikes), "spikes").startswith("3 spikes of up to 30")
    assert "for 4.0" in message(inspected(stuck_force), "stuck")
    assert "+0.8" in message(inspected(offset), "force offset")
    assert message(inspected(mirrored_command), "command sign").startswith(
        "the angle moves opposite to its command"
    )


def test_an_issue_lists_all_its_logs_and_its_first_place():
    issue = next(one for one in inspected(spikes).issues if one.name == "spikes")
    assert issue.logs == ("train/0", "test/1")
    assert (issue.log, issue.column, issue.row) == ("train/0", "force_x", 500)
    assert issue.place == "train/0, row 500, column force_x"


def test_fixes_go_on_from_the_options_that_were_given():
    given = ImportConfig(force="y,x", force_lag_ms=30, negate=("command_angle",))
    assert grave(inspected(swap, given))["force axes"].startswith("--force=x,y;")
    assert "--force-lag 70" in grave(inspected(late_force, given))["force lag"]
    assert "remove --negate" in grave(inspected(mirrored_command, given))["command sign"]


def test_one_log_with_another_clock_and_another_offset_stands_out():
    logs = tank_logs(4)
    delay = to_columns(logs[3])
    shifted = to_columns(logs[2])
    late_force(delay)
    shifted["force_y_n"] += 0.9
    found = grave(inspect(named(logs[0], logs[1], log_of(shifted), log_of(delay))))
    assert {"force lag", "force offset"} == found.keys()


def test_commands_that_leave_their_range_empty_are_reported():
    tied = []
    for log in tank_logs(5):
        columns = to_columns(log)
        columns["command_velocity_rad_s"] = 3 + columns["command_angle_rad"]
        tied.append(log_of(columns))
    assert "coverage" in grave(inspect(named(*tied, test=0)))


def test_one_commanded_velocity_is_not_an_empty_range():
    fixed = []
    for log in tank_logs(5):
        columns = to_columns(log)
        columns["command_velocity_rad_s"] = 0 * columns["command_angle_rad"] + 3
        fixed.append(log_of(columns))
    assert "coverage" not in grave(inspect(named(*fixed, test=0)))


def test_no_test_logs_is_a_note():
    issues = inspect(named(*tank_logs(2), test=0)).issues
    assert [(one.severity, one.name) for one in issues] == [("note", "no test logs")]


def test_an_inspection_is_json_with_lags_in_milliseconds():
    described = inspected(late_force).to_dict()
    assert described["issues"][0]["name"] == "force lag"
    assert described["logs"][0]["force_lag_ms"] == pytest.approx(72, abs=5)
    assert described["summary"]["counts"] == {"error": 1, "warning": 0, "note": 0}
