import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.quantities import TICK_S, Command
from softfin.tank.drive import DEAD_TICKS, Drive, DriveConfig

STEP = 0.005
DIRECT = DriveConfig(lag_s=0.0, acceleration_rad_s2=60.0, encoder_step_rad=0.0)


@jax.jit
def run(drive, commands, load=0.0):
    """The states after each step, with `load` on the shaft [N m]."""

    def step(state, command):
        planned = drive.plan(state, command, STEP)
        rate = drive.shaft(state, planned, STEP).turn(jnp.asarray(load), jnp.asarray(0.0))
        state = drive.follow(state, planned, rate, STEP)
        return state, state

    return jax.lax.scan(step, drive.rest(), commands)[1]


def commands(*pieces):
    """Of (angle, velocity, seconds)."""
    columns = [
        np.concatenate([np.full(round(p[2] / STEP), p[i], np.float32) for p in pieces])
        for i in (0, 1)
    ]
    return Command(*map(jnp.asarray, columns))


def test_one_radian_at_two_radians_a_second_is_exactly_that():
    states = run(Drive(DIRECT), commands((1.0, 2.0, 2.0)))
    angle = np.asarray(states.profile_angle)
    velocity = np.asarray(states.profile_velocity)
    assert velocity.max() == pytest.approx(2.0, abs=1e-6)
    arrival = (np.argmax(angle > 1 - 1e-4) + 1) * STEP
    assert arrival == pytest.approx(1.0 / 2.0 + 2.0 / 60.0, abs=2 * STEP)
    assert angle[-1] == pytest.approx(1.0, abs=1e-6)
    assert angle.max() < 1.0 + 1e-3


def test_half_way_the_profile_is_on_the_trapezoid():
    states = run(Drive(DIRECT), commands((1.0, 2.0, 0.25)))
    assert states.profile_angle[-1] == pytest.approx(2.0 * 0.25 - 2.0**2 / (2 * 60.0), abs=2e-3)


def test_a_short_move_never_reaches_the_commanded_velocity():
    states = run(Drive(DIRECT), commands((0.05, 3.0, 1.0)))
    assert np.asarray(states.profile_velocity).max() == pytest.approx(
        np.sqrt(0.05 * 60.0), rel=0.15
    )
    assert states.profile_angle[-1] == pytest.approx(0.05, abs=1e-6)


def test_a_command_in_midstroke_is_planned_from_the_present_motion():
    states = run(Drive(DIRECT), commands((1.0, 2.0, 0.3), (-1.0, 3.0, 2.0)))
    angle = np.asarray(states.profile_angle)
    velocity = np.asarray(states.profile_velocity)
    assert np.abs(np.diff(velocity)).max() <= 60.0 * STEP * 1.0001
    assert np.abs(np.diff(angle)).max() <= 3.0 * STEP * 1.0001
    assert velocity.min() == pytest.approx(-3.0, abs=1e-5)
    assert angle[-1] == pytest.approx(-1.0, abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-1.57, 1.57), st.floats(1, 3.14)), min_size=1, max_size=4),
    st.sampled_from([20, 33, 60]),
)
def test_velocity_and_acceleration_stay_within_limits_whatever_is_commanded(moves, held):
    left = 1000 - held * len(moves)
    series = commands(
        *((angle, velocity, held * STEP) for angle, velocity in moves), (0.5, 1.0, left * STEP)
    )
    states = run(Drive(DIRECT), series)
    velocity = np.concatenate([[0.0], states.profile_velocity])
    assert np.abs(velocity).max() <= max(v for _, v in moves) + 1e-5
    assert np.abs(np.diff(velocity)).max() <= 60.0 * STEP * 1.001
    assert states.profile_angle[-1] == pytest.approx(0.5, abs=1e-5)


def test_the_motor_follows_a_steady_profile_at_its_velocity_and_one_lag_behind():
    lag = 0.1
    states = run(Drive(DriveConfig(lag_s=lag)), commands((1.5, 1.0, 1.2)))
    assert states.rate[-1] == pytest.approx(1.0, abs=1e-4)
    assert states.profile_angle[-1] - states.angle[-1] == pytest.approx(lag * 1.0, abs=1e-4)


def test_without_lag_the_motor_is_where_the_profile_is():
    states = run(Drive(DIRECT), commands((1.0, 2.0, 2.0)))
    np.testing.assert_allclose(states.angle, states.profile_angle, atol=0.02)
    assert states.angle[-1] == pytest.approx(1.0, abs=1e-5)


def test_a_load_turns_the_held_motor_by_load_over_stiffness():
    states = run(Drive(DriveConfig(stiffness_nm_rad=50.0)), commands((0.0, 1.0, 3.0)), 2.0)
    assert states.angle[-1] == pytest.approx(2.0 / 50.0, rel=1e-3)
    assert states.torque[-1] == pytest.approx(-2.0, rel=1e-3)


def test_the_torque_ends_at_its_limit_and_then_the_rotor_alone_sets_the_acceleration():
    config = DriveConfig(torque_limit_nm=0.1, inertia_kg_m2=0.02, fastest_rad_s=10.0, lag_s=0.0)
    states = run(Drive(config), commands((1.5, 10.0, 0.3)))
    assert np.abs(states.torque).max() == pytest.approx(0.1, rel=1e-5)
    np.testing.assert_allclose(np.diff(np.asarray(states.rate)[5:40]) / STEP, 0.1 / 0.02, rtol=1e-3)
    stalled = run(Drive(config), commands((1.5, 10.0, 0.3)), -0.2)
    assert stalled.angle[-1] < 0.0


@pytest.mark.parametrize(
    ("dead", "ticks"), [(0.0, 0.0), (0.03, 3.0), (0.025, 2.5), (DEAD_TICKS * TICK_S, DEAD_TICKS)]
)
def test_a_command_is_obeyed_after_the_dead_time(dead, ticks):
    drive = Drive(DriveConfig(dead_time_s=dead))
    state = drive.rest()
    obeyed = []
    for _ in range(DEAD_TICKS + 2):
        state, command = drive.receive(state, Command(jnp.float32(1.0), jnp.float32(2.0)))
        obeyed.append([float(command.angle), float(command.velocity)])
    reached = np.clip(np.arange(DEAD_TICKS + 2) - ticks + 1, 0, 1)
    np.testing.assert_allclose(obeyed, reached[:, None] * [1.0, 2.0], atol=1e-5)


def test_the_encoder_reads_multiples_of_its_step_or_the_angle_itself():
    state = Drive(DIRECT).rest()._replace(angle=jnp.asarray(0.1234))
    assert Drive(DriveConfig(encoder_step_rad=0.01)).read(state)[0] == pytest.approx(0.12)
    assert Drive(DIRECT).read(state)[0] == pytest.approx(0.1234)
