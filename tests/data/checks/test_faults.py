"""Faults of logs of three fins, the issue that each makes and what its fix says.

A fault changes a copy of the columns of a good log.
"""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import signal

from softfin.data.checks.inspection import inspect
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import Issue
from tests.data.faulty import Columns, cut, log_of, named, tank_logs, to_columns

FORCES = ("force_x_n", "force_y_n")
ANGLES = ("angle_rad", "command_angle_rad")

Fault = Callable[[Columns], None]


def found(*logs: Columns, config: ImportConfig | None = None) -> dict[str, Issue]:
    inspection = inspect(named(*map(log_of, logs), test=0), config=config)
    return {one.name: one for one in inspection.issues if one.name != "no test logs"}


def faulty(fault: Fault, fin: str = "tank", index: int = 0) -> Columns:
    columns = to_columns(tank_logs(index + 1, fin)[index])
    fault(columns)
    return columns


def turned(degrees: float | None) -> Fault:
    """Without an angle, the sensor turns with the shaft."""

    def fault(columns: Columns) -> None:
        angle = columns["angle_rad"] if degrees is None else np.radians(degrees)
        x, y = (columns[name] for name in FORCES)
        columns["force_x_n"] = x * np.cos(angle) - y * np.sin(angle)
        columns["force_y_n"] = x * np.sin(angle) + y * np.cos(angle)

    return fault


def of_forces(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def fault(columns: Columns) -> None:
        for name in FORCES:
            columns[name] = change(columns[name])

    return fault


def times(name: str, factor: float) -> Fault:
    def fault(columns: Columns) -> None:
        columns[name] = columns[name] * factor

    return fault


def drifting(values: np.ndarray) -> np.ndarray:
    return values + np.linspace(-0.7, 0.7, len(values)) * values.std()


def low_passed(cutoff_hz: float) -> Callable[[np.ndarray], np.ndarray]:
    factor = np.exp(-2 * np.pi * cutoff_hz / 100)
    return lambda values: signal.lfilter([1 - factor], [1, -factor], values)


def smoothed_afterwards(values: np.ndarray) -> np.ndarray:
    both_ways = signal.butter(2, 2 / 50)
    return signal.filtfilt(*both_ways, values)


def held(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[::10], 10)[: len(values)]


def clipped_and_averaged(values: np.ndarray) -> np.ndarray:
    limit = np.percentile(np.abs(values), 92)
    return np.convolve(np.clip(values, -limit, limit), np.full(5, 0.2), "same")


def frozen(values: np.ndarray) -> np.ndarray:
    """But for a count in either direction, in two stretches."""
    count = 1e-3 * np.ptp(values)
    values = np.round(values / count) * count
    noise = np.random.default_rng(0).integers(-1, 2, len(values)) * count
    for start in (1000, 4000):
        values[start : start + 1000] = values[start] + noise[:1000]
    return values


def with_zeros_and_doubles(values: np.ndarray) -> np.ndarray:
    rows = np.random.default_rng(0).choice(len(values), 120, replace=False)
    values[rows[:60]] = 0
    values[rows[60:]] *= 2
    return values


def late(ticks: int) -> Fault:
    return of_forces(lambda values: np.roll(values, ticks))


def late_at_times(columns: Columns) -> None:
    for name in FORCES:
        delayed = np.roll(columns[name], 30)
        for start in (1200, 4200):
            columns[name][start : start + 600] = delayed[start : start + 600]


def slower_loop(columns: Columns) -> None:
    """At 80 Hz, stamped as 100 Hz. The velocity is the drive's."""
    time = columns["time_s"]
    stamps = time[: len(time) * 4 // 5]
    for name in columns:
        if name != "time_s":
            columns[name] = np.interp(stamps * 1.25, time, columns[name])
    columns["time_s"] = stamps


def repeated(columns: Columns) -> None:
    again = np.arange(len(columns["time_s"])) // 4 * 4
    for name in columns:
        if name != "time_s":
            rows = np.arange(len(again))
            rows[again + 1 == rows] -= 1
            columns[name] = columns[name][rows]


FAULTS = {
    "turned by 20 degrees": (turned(20), "error", "turned force", "a = -2"),
    "turned by -30 degrees": (turned(-30), "error", "turned force", "degrees"),
    "turned by 45 degrees": (turned(45), "error", "turned force", ""),
    "turned with the shaft": (turned(None), "error", "shaft frame", "fix the sensor"),
    "drift": (of_forces(drifting), "warning", "force drift", "subtract the drift"),
    "low-pass of 2 Hz": (of_forces(low_passed(2)), "warning", "filtered force", "switch off"),
    "low-pass in both directions": (
        of_forces(smoothed_afterwards),
        "warning",
        "filtered force",
        "switch off",
    ),
    "sensor at 10 Hz": (of_forces(held), "warning", "repeated values", "100 Hz"),
    "clipped": (of_forces(clipped_and_averaged), "warning", "saturated", "larger range"),
    "frozen": (of_forces(frozen), "error", "stuck", "remove these rows"),
    "single samples": (of_forces(with_zeros_and_doubles), "error", "spikes", "repair"),
    "force 300 ms late": (late(30), "error", "force clock", "synchronize"),
    "force 3 s early": (late(-300), "error", "force clock", "synchronize"),
    "force late at times": (late_at_times, "error", "changing lag", "synchronize"),
    "force in counts": (of_forces(lambda values: values * 1e6), "error", "force size", "N"),
    "velocity in rpm": (times("velocity_rad_s", 9.549), "error", "velocity unit", "velocity=rpm"),
    "velocity in degrees": (
        times("velocity_rad_s", 57.3),
        "error",
        "velocity unit",
        "velocity=deg",
    ),
    "clock": (slower_loop, "warning", "velocity unit", "check the clock"),
    "command in rpm": (
        times("command_velocity_rad_s", 9.549),
        "error",
        "command velocity unit",
        "--angles command_velocity=rpm",
    ),
    "command in degrees": (
        times("command_velocity_rad_s", 57.3),
        "error",
        "command velocity unit",
        "--angles command_velocity=deg",
    ),
    "command read as degrees": (
        times("command_velocity_rad_s", 1 / 57.3),
        "error",
        "command velocity unit",
        "--angles command_velocity=rad",
    ),
    "command in registers": (
        times("command_velocity_rad_s", 41.7),
        "error",
        "command velocity unit",
        "multiply the column by 0.024",
    ),
    "10-bit counts": (times("angle_rad", 0.293), "warning", "speed", "1,023"),
    "repeated rows": (repeated, "note", "repeated values", "once per row"),
}


@pytest.mark.parametrize("fin", ["tank", "hand", "vehicle"])
@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found_with_its_severity_and_fix(fault, fin):
    change, severity, name, fix = FAULTS[fault]
    issue = found(faulty(change, fin))[name]
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


def shifted(degrees: float) -> Fault:
    def fault(columns: Columns) -> None:
        for name in ANGLES:
            columns[name] = columns[name] + np.radians(degrees)

    return fault


@pytest.mark.parametrize("degrees", [90, 180])
def test_the_zero_of_the_angle_comes_before_the_axes(degrees):
    # Servos are often at 90 degrees in their centre.
    issues = found(faulty(shifted(degrees)))
    assert next(iter(issues)) == "angle zero"
    assert issues["angle zero"].fix.endswith(f"--angle-zero {degrees} (deg)")
    assert "force axes" not in issues


def test_an_angle_zero_in_a_known_unit_is_one_number():
    columns = faulty(shifted(90))
    config = ImportConfig(angles={"angle": "deg", "command_angle": "deg"}, angle_zero=5)
    assert found(columns, config=config)["angle zero"].fix.endswith("--angle-zero 95 (deg)")


def test_an_angle_zero_off_by_20_degrees_and_a_turned_sensor_are_both_listed():
    fix = found(faulty(shifted(20)))["turned force"].fix
    assert "by a = -20 degrees" in fix
    assert "--angle-zero 20 " in fix


@pytest.mark.parametrize(
    ("quarters", "frame", "zero"), [(1, "y,-x", 90), (2, "-x,-y", -180), (3, "-y,x", -90)]
)
def test_axes_and_angle_zero_explain_a_quarter_turn_equally(quarters, frame, zero):
    fix = found(faulty(turned(90 * quarters)))["force axes"].fix
    assert fix.startswith(f"--force={frame};")
    assert f"at {-zero} degrees where the log has 0" in fix
    assert f"--angle-zero {zero} " in fix
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
    assert found(columns).keys() == {"speed"}


def test_a_unit_is_added_to_those_that_were_given():
    config = ImportConfig(angles={"velocity": "deg"})
    columns = faulty(times("command_velocity_rad_s", 9.549))
    fix = found(columns, config=config)["command velocity unit"].fix
    assert fix == "--angles velocity=deg,command_velocity=rpm"
