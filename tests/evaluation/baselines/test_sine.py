import numpy as np
import pytest

from softfin.core.quantities import Limits
from softfin.evaluation.baselines.sine import Sine, commanded

LIMITS = Limits(-1.5, 1.5, 1.0, 3.0)


def one(centre, amplitude, frequency):
    return Sine(np.float64(centre), np.float64(amplitude), np.float64(frequency))


def test_the_target_goes_along_the_sine_of_the_reading_it_leads_to():
    command, _ = commanded(LIMITS, one(0.3, 0.2, 1.0), 100)
    time = (np.arange(100) + 1) / 100
    np.testing.assert_allclose(command.angle, 0.3 + 0.2 * np.sin(2 * np.pi * time), atol=1e-5)


def test_the_velocity_is_the_fastest_that_the_sine_needs_within_the_limits():
    for amplitude, expected in ((0.3, 2 * np.pi * 0.3), (0.1, 1.0), (1.0, 3.0)):
        command, _ = commanded(LIMITS, one(0.0, amplitude, 1.0), 10)
        np.testing.assert_allclose(command.velocity, expected, rtol=1e-6)


def test_a_sine_within_the_limits_is_not_clipped_at_all():
    _, clipped = commanded(LIMITS, one(1.0, 0.45, 1.0), 200)
    assert (float(clipped.angle), float(clipped.velocity)) == (0.0, 0.0)


def test_each_tick_beyond_the_angles_is_kept_within_them_and_counted():
    """About 1.2 rad, 0.6 rad: beyond 1.5 rad while the sine is above a half, a third of the time."""
    command, clipped = commanded(LIMITS, one(1.2, 0.6, 0.5), 200)
    assert float(command.angle.max()) == pytest.approx(1.5)
    assert float(clipped.angle) == pytest.approx(1 / 3, abs=0.011)


def test_each_tick_that_is_too_fast_is_counted():
    """A greatest speed of 6 rad/s under a limit of 3: too fast while the cosine is above a half, two thirds of it."""
    _, clipped = commanded(LIMITS, one(0.0, 6 / np.pi, 0.5), 200)
    assert float(clipped.velocity) == pytest.approx(2 / 3, abs=0.011)


def test_many_sines_are_those_one_by_one():
    sines = Sine(np.array([0.1, 1.2]), np.array([0.3, 0.9]), np.array([1.0, 2.0]))
    command, clipped = commanded(LIMITS, sines, 50)
    assert command.angle.shape == command.velocity.shape == (2, 50)
    for i in range(2):
        alone, share = commanded(LIMITS, one(*(part[i] for part in sines)), 50)
        np.testing.assert_array_equal(command.angle[i], alone.angle)
        assert float(clipped.velocity[i]) == float(share.velocity)
