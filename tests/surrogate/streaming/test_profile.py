import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.quantities import TICK_S, Command
from softfin.surrogate.streaming.profile import Profile
from softfin.surrogate.streaming.segments import MAX_DELAY, Motion
from softfin.tank.drive import Drive, DriveConfig
from tests.surrogate.streaming import small

STEPS = 2


def tank_drive(config, commands):
    """Angle and velocity behind each command of a drive with nothing on its shaft."""
    drive = Drive(config)
    seconds = TICK_S / STEPS
    free = jnp.zeros(())

    def tick(state, command):
        state, obeyed = drive.receive(state, command)
        for _ in range(STEPS):
            planned = drive.plan(state, obeyed, seconds)
            rate = drive.shaft(state, planned, seconds).turn(free, free)
            state = drive.follow(state, planned, rate, seconds)
        return state, (state.angle, state.rate)

    return jax.jit(lambda commands: jax.lax.scan(tick, drive.rest(), commands)[1])(commands)


@pytest.mark.parametrize(("dead_time", "delay"), [(0.0, 0.0), (0.03, 3.0), (0.025, 2.5)])
def test_an_unloaded_stiff_drive_of_the_tank_follows_its_profile(dead_time, delay):
    commands = small.commands(400, seed=3)
    stiff = DriveConfig(
        dead_time_s=dead_time,
        lag_s=0.0,
        acceleration_rad_s2=60.0,
        encoder_step_rad=0.0,
        stiffness_nm_rad=1e6,
        inertia_kg_m2=1e-5,
        torque_limit_nm=1e6,
        fastest_rad_s=100.0,
    )
    angle, _ = tank_drive(stiff, commands)
    said = small.followed(Profile(delay=delay, acceleration=60.0), commands)
    np.testing.assert_allclose(said.angle[1:], angle[:-1], atol=1e-3)
    assert np.ptp(said.angle) > 2


def settled(profile, angle=1.0, velocity=2.0, ticks=300):
    commands = Command(*(jnp.full(ticks, value, jnp.float32) for value in (angle, velocity)))
    return small.followed(profile, commands)


def test_gain_and_zero_say_what_is_read_where_it_stands():
    assert settled(Profile(gain=1.1, zero=0.05)).angle[-1] == pytest.approx(1.15, abs=1e-5)


def test_the_velocity_is_the_commanded_one_by_its_factor_up_to_the_limit():
    assert settled(Profile(velocity_factor=0.9)).velocity.max() == pytest.approx(1.8, abs=1e-4)
    assert settled(Profile(velocity_limit=1.5)).velocity.max() == pytest.approx(1.5, abs=1e-4)


def test_it_speeds_up_and_brakes_by_its_acceleration():
    velocity = np.asarray(settled(Profile(acceleration=10.0)).velocity)
    assert np.diff(velocity).max() == pytest.approx(10.0 * TICK_S, rel=1e-3)
    assert np.diff(velocity).min() >= -10.0 * TICK_S * 1.01


def test_a_lag_puts_the_shaft_behind_by_its_velocity():
    before = settled(Profile())
    behind = settled(Profile(lag=0.03))
    np.testing.assert_allclose(behind.angle, before.angle - 0.03 * before.velocity, atol=1e-6)


def test_a_profile_in_motion_begins_where_the_shaft_is_and_with_what_was_commanded_before():
    profile = Profile(lag=0.03, delay=MAX_DELAY)
    now = Motion(jnp.float32(0.4), jnp.float32(1.5))
    state = profile.start(now, Command(jnp.full(MAX_DELAY, 0.9), jnp.full(MAX_DELAY, 1.5)))
    for one, other in zip(profile.shaft(state.motion), now, strict=True):
        assert float(one) == pytest.approx(float(other), abs=1e-6)
    for _ in range(MAX_DELAY):
        state, obeyed = profile.step(state, Command(jnp.float32(-1.0), jnp.float32(3.0)))
        assert float(obeyed.angle) == pytest.approx(0.9)
    _, obeyed = profile.step(state, Command(jnp.float32(-1.0), jnp.float32(3.0)))
    assert float(obeyed.angle) == pytest.approx(-1.0)
