import numpy as np
import pytest

from softfin.data.checks.alignment import command_lag, find_force_lag, frame_correlations
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.tank import Tank, TankConfig
from tests.data.faulty import recorded, tank_logs, to_columns


def force_lag(angle, force):
    return find_force_lag(angle, force @ [1, 1j]).force_lag_ms


@pytest.fixture(scope="module")
def log():
    columns = to_columns(tank_logs()[0])
    force = np.stack([columns["force_x_n"], columns["force_y_n"]], axis=1)
    return columns["command_angle_rad"], columns["angle_rad"], force


@pytest.mark.parametrize("ticks", [-5, -2, 3, 6])
def test_lags_move_with_the_clocks_by_as_much(log, ticks):
    command, angle, force = log
    late_command = command_lag(np.roll(command, ticks), angle)
    late_force = force_lag(angle, np.roll(force, ticks, axis=0))
    assert late_command == pytest.approx(command_lag(command, angle) - 10 * ticks, abs=1)
    assert late_force == pytest.approx(force_lag(angle, force) + 10 * ticks, abs=1)


def test_the_lag_of_the_command_is_the_drives_dead_time(log):
    command, angle, _ = log
    # 29 ms in the tank; the angle is told at ticks of 10 ms.
    assert command_lag(command, angle) == pytest.approx(29, abs=6)


def test_a_mirrored_command_has_the_same_lag(log):
    command, angle, _ = log
    assert command_lag(-command, angle) == command_lag(command, angle)


def test_a_slow_drive_that_is_always_on_its_way_has_the_same_dead_time():
    # Only its drive matters: two plates are compiled in half the time.
    slow = Tank(
        TankConfig().changed(
            [
                "drive.slowest_rad_s=0.3",
                "drive.fastest_rad_s=1.57",
                "fin.plates=2",
                "steps_per_tick=4",
            ]
        )
    )
    columns = to_columns(recorded(slow, 1, 6000)[0])
    assert command_lag(columns["command_angle_rad"], columns["angle_rad"]) == pytest.approx(
        29, abs=6
    )


def test_strokes_to_and_fro_have_the_same_dead_time():
    # Before each command the fin always moves the other way.
    command = np.repeat([0.5, -0.5] * 40, 40)
    angle = np.zeros(len(command))
    for tick in range(4, len(command)):
        angle[tick] = angle[tick - 1] + np.clip(command[tick - 4] - angle[tick - 1], -0.04, 0.04)
    assert command_lag(command, angle) == pytest.approx(30, abs=6)


def test_the_lag_of_the_force_is_told_whatever_its_axes(log):
    _, angle, force = log
    turned = force_lag(angle, force[:, ::-1] * [-1, 1])
    assert turned == pytest.approx(force_lag(angle, force), abs=0.01)


def test_no_lag_is_told_from_few_commands_or_noise(log):
    command, angle, _ = log
    assert command_lag(command[:1000], angle[:1000]) is None
    noise = np.random.default_rng(0).normal(size=(len(angle), 2))
    assert force_lag(angle, noise) is None


@pytest.mark.parametrize("frame", FORCE_FRAMES)
def test_each_way_to_turn_the_axes_is_told_from_the_others(log, frame):
    _, angle, force = log
    x, y = frame.split(",")
    turned = np.empty_like(force)
    # Such that taking `frame` of it gives the force back.
    for axis, term in enumerate((x, y)):
        turned[:, "xy".index(term[-1])] = force[:, axis] * (-1 if term.startswith("-") else 1)
    correlations = frame_correlations(angle, np.roll(turned, -2, axis=0) @ [1, 1j])
    assert max(correlations, key=correlations.__getitem__) == frame
    assert correlations[frame] > 0.85
    assert all(other < 0.6 for name, other in correlations.items() if name != frame)


def test_noise_fits_no_frame(log):
    _, angle, _ = log
    noise = np.random.default_rng(0).normal(size=(len(angle), 2))
    assert max(frame_correlations(angle, noise @ [1, 1j]).values()) < 0.1
