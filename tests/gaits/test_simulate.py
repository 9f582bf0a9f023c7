"""Gaits and what they do to a plant whose forces are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.gaits.simulate import (
    AMPLITUDES,
    SIDE_BY_SIDE,
    VELOCITIES,
    gait_families,
    gait_sensitivity,
    strokes,
)
from tests.gaits.mapped import simulate_gait, steady_state_force
from tests.plants import AnalyticFin, StrokeFin

KEY = jax.random.key(0)
SWEEP = np.array([(1, 1), (-1, 1)] * 3, np.float32)
"""From one end to the other and back, as fast as may be."""


def test_the_mean_force_is_that_of_the_strokes():
    """Each stroke of 180 degrees at pi rad/s pushes 0.5 pi 2 N along its middle, which is straight
    ahead."""
    got = simulate_gait(StrokeFin(bias=(0.2, -0.1)), SWEEP, 2, KEY)
    np.testing.assert_allclose(got.force, [np.pi + 0.2, -0.1], atol=1e-4)
    np.testing.assert_allclose(got.smoothness, 0, atol=1e-3)


def test_strokes_count_by_the_ticks_that_they_are_held():
    """Of three strokes, of 0, 90 and 90 degrees, the last is held 34 ticks."""
    gait = np.tile(np.array([(1, -1), (1, -1), (0, -1)], np.float32), (2, 1))
    push = 0.5 * np.exp(-1j * np.pi / 4)
    expected = push * (PAPER_CLOCK.ticks[0] + PAPER_CLOCK.ticks[2]) / sum(PAPER_CLOCK.ticks)
    np.testing.assert_allclose(
        simulate_gait(StrokeFin(), gait, 2, KEY).force, [expected.real, expected.imag], atol=1e-4
    )


def test_the_sobolev_term_is_of_the_steps_from_stroke_to_stroke():
    gait = np.tile(np.array([(1, -1), (1, -1), (0, -1)], np.float32), (2, 1))
    step = 0.5 * np.cos(np.pi / 4)
    # F, 0, F and again F, 0, F: four steps within the window.
    got = simulate_gait(StrokeFin(), gait, 2, KEY).smoothness
    np.testing.assert_allclose(
        got[0], np.sqrt(4 * step**2 / (PAPER_CLOCK.window_ticks - 1)), rtol=1e-3
    )


def test_the_last_cycle_counts():
    """The first begins in the middle, the others at one end."""
    gait = np.array([(1, 1)] * 3 + [(-1, 1)] * 3, np.float32)
    force = np.asarray(steady_state_force(AnalyticFin(noise_n=0.0), gait, 3, KEY))
    assert force.shape == (3 * PAPER_CLOCK.window_ticks, 2)
    got = simulate_gait(AnalyticFin(noise_n=0.0), gait, 3, KEY).force
    np.testing.assert_allclose(
        got, force[-PAPER_CLOCK.window_ticks :].mean(axis=0), rtol=1e-4, atol=1e-5
    )
    assert not np.allclose(got, force[: PAPER_CLOCK.window_ticks].mean(axis=0), rtol=1e-3)


def test_a_gait_is_not_repeated_for_a_shorter_time_if_windows_are_short():
    clock = ActionClock.at(10, 0.6)
    gait = np.resize(np.array([(0.5, 1), (-0.5, 1)], np.float32), (clock.window_actions, 2))
    force = np.asarray(steady_state_force(StrokeFin(), gait, 3, KEY, clock))
    assert force.shape == (10 * clock.window_ticks, 2)


def test_in_the_steady_state_the_moving_average_has_no_ripple():
    gait = stroke(2, 1.0, -0.5, 0.75)
    force = np.asarray(steady_state_force(AnalyticFin(noise_n=0.0), gait, 3, KEY), float)
    averages = np.array(
        [
            force[k : k + PAPER_CLOCK.window_ticks].mean(axis=0)
            for k in range(PAPER_CLOCK.window_ticks, 2 * PAPER_CLOCK.window_ticks)
        ]
    )
    assert np.ptp(force[PAPER_CLOCK.window_ticks :, 0]) > 0.1
    assert np.ptp(averages, axis=0).max() < 1e-4


FAMILIES = gait_families(PAPER_CLOCK)
WAVEFORMS = [waveform for waveform, _ in FAMILIES[:: len(VELOCITIES)]]


def stroke(waveform: int, velocity: float, centre: float, amplitude: float) -> np.ndarray:
    return strokes(WAVEFORMS[waveform], velocity, np.array([centre]), np.array([amplitude]))[0]


def test_strokes_beat_about_their_centres_at_one_velocity_within_the_limits():
    middle = stroke(0, 0.3, 0.0, AMPLITUDES[0])
    np.testing.assert_allclose(
        middle[:, 0], AMPLITUDES[0] * np.array([1, -1, 1, -1, 1, -1]), atol=1e-6
    )
    np.testing.assert_array_equal(middle[:, 1], np.float32(0.3))
    assert np.abs(stroke(1, 1.0, 1.0, 0.9)).max() == 1


def test_every_waveform_is_tried_at_every_velocity():
    assert len(FAMILIES) == len(WAVEFORMS) * len(VELOCITIES) == 9
    assert {velocity for _, velocity in FAMILIES} == set(VELOCITIES)


@pytest.mark.parametrize("actions", [3, 4, 5, 12])
def test_the_strokes_of_another_clock_fill_its_window(actions: int):
    clock = ActionClock(ticks=(10,), window_actions=actions)
    families = gait_families(clock)
    assert len(families) >= len(VELOCITIES)
    for waveform, _ in families:
        assert len(waveform) == actions
        assert np.abs(waveform).max() == 1
        assert np.ptp(waveform) > 1


def test_the_slope_of_the_mean_force_is_that_of_finite_differences():
    gait = jnp.asarray(stroke(0, 0.8, 0.0, 0.4), jnp.float32)
    force = jax.jit(
        jax.value_and_grad(lambda gait: simulate_gait(StrokeFin(), gait, 2, KEY).force[0])
    )
    slope = force(gait)[1][2, 0]
    step = 1e-2
    up, down = (force(gait.at[2, 0].add(sign * step))[0] for sign in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-2)


def test_gaits_in_threads_are_those_of_one_thread_to_the_last_bit(monkeypatch):
    values = np.random.default_rng(0).normal(0, 0.3, (2 * SIDE_BY_SIDE + 1, 12))
    found = []
    for cores in (1, 4):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found.append(
            gait_sensitivity(AnalyticFin(), values.astype(np.float32), 2, KEY, PAPER_CLOCK)
        )
    for alone, together in zip(*found, strict=True):
        assert len(alone) == len(values)
        np.testing.assert_array_equal(alone, together)
