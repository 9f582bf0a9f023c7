import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError, RunError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.evaluation.baselines.sines import (
    InverseConfig,
    ShaftSine,
    amplitude_for,
    fit_constant,
    inverse,
    mean_force,
)

LIMITS = Limits(-1.5, 1.5, 1.0, 3.0)


def one(centre, amplitude, frequency):
    return ShaftSine(np.float64(centre), np.float64(amplitude), np.float64(frequency))


def test_the_target_goes_along_the_sine_of_the_reading_it_leads_to():
    command, *_ = one(0.3, 0.2, 1.0).commands(LIMITS, 100)
    time = (np.arange(100) + 1) / 100
    np.testing.assert_allclose(command.angle, 0.3 + 0.2 * np.sin(2 * np.pi * time), atol=1e-5)


def test_the_velocity_is_the_fastest_that_the_sine_needs_within_the_limits():
    for amplitude, expected in ((0.3, 2 * np.pi * 0.3), (0.1, 1.0), (1.0, 3.0)):
        command, *_ = one(0.0, amplitude, 1.0).commands(LIMITS, 10)
        np.testing.assert_allclose(command.velocity, expected, rtol=1e-6)


def test_a_sine_within_the_limits_is_not_clipped_at_all():
    _, angle, velocity = one(1.0, 0.45, 1.0).commands(LIMITS, 200)
    assert (float(angle), float(velocity)) == (0.0, 0.0)


def test_each_tick_beyond_the_angles_is_kept_within_them_and_counted():
    """About 1.2 rad, 0.6 rad: beyond 1.5 rad while the sine is above a half, a third of the time."""
    command, angle, _ = one(1.2, 0.6, 0.5).commands(LIMITS, 200)
    assert float(command.angle.max()) == pytest.approx(1.5)
    assert float(angle) == pytest.approx(1 / 3, abs=0.011)


def test_each_tick_that_is_too_fast_is_counted():
    """A greatest speed of 6 rad/s under a limit of 3: too fast while the cosine is above a half, two thirds of it."""
    _, _, velocity = one(0.0, 6 / np.pi, 0.5).commands(LIMITS, 200)
    assert float(velocity) == pytest.approx(2 / 3, abs=0.011)


def test_many_sines_are_those_one_by_one():
    many = ShaftSine(np.array([0.1, 1.2]), np.array([0.3, 0.9]), np.array([1.0, 2.0]))
    command, _, velocity = many.commands(LIMITS, 50)
    assert command.angle.shape == command.velocity.shape == (2, 50)
    for i in range(2):
        alone, _, alone_velocity = one(*(part[i] for part in many)).commands(LIMITS, 50)
        np.testing.assert_array_equal(command.angle[i], alone.angle)
        assert float(velocity[i]) == float(alone_velocity)


CONFIG = InverseConfig()


def sines(*forces, frequency=2.1, constant=CONFIG.constant):
    return inverse(np.array(forces, np.float64), frequency, PAPER_LIMITS, CONFIG, constant)


def test_the_constant_is_that_of_the_u_cat_fins():
    assert CONFIG.constant == pytest.approx(0.24 * np.pi**2, rel=1e-12)


@pytest.mark.parametrize(
    ("force_n", "frequency_hz", "amplitude_rad"),
    # A right angle takes K f^2, 60 degrees take half of that.
    [(10.44599, 2.1, np.pi / 2), (5.222995, 2.1, np.pi / 3), (2.866133, 1.1, np.pi / 2), (0.0, 1.1, 0.0)],
)
def test_the_amplitude_has_its_known_values(force_n, frequency_hz, amplitude_rad):
    assert amplitude_for(np.array(force_n), frequency_hz, CONFIG.constant) == pytest.approx(amplitude_rad, abs=1e-5)


@given(st.floats(0.0, 20.0), st.floats(0.5, 4.0))
def test_the_force_of_the_amplitude_for_a_force_is_that_force(force, frequency):
    most = 2 * CONFIG.constant * frequency**2
    found = mean_force(amplitude_for(np.array(force), frequency, CONFIG.constant), frequency, CONFIG.constant)
    assert float(found) == pytest.approx(min(force, most), abs=1e-6)


def test_a_force_towards_minus_y_is_made_at_a_positive_angle():
    centre = sines((0, -1), (1, -1), (2, 0), (1, 1), (0, 1)).sine.centre
    np.testing.assert_allclose(centre, [np.pi / 2, np.pi / 4, 0, -np.pi / 4, -np.pi / 2])


def test_amplitudes_are_kept_within_the_drivers_range_and_marked():
    found = sines((2, 0), (0.01, 0), (30, 0))
    np.testing.assert_array_equal(found.amplitude_limited, [False, True, True])
    np.testing.assert_allclose(found.sine.amplitude[1:], [0.1, 1.2])


def test_a_direction_that_the_plant_cannot_take_is_kept_at_its_edge_and_marked():
    found = sines((-1, -1), (1, -1))
    np.testing.assert_array_equal(found.direction_limited, [True, False])
    assert found.sine.centre[0] == PAPER_LIMITS.angle_max


def test_recalibration_finds_the_constant_of_a_fin_that_obeys_the_model():
    angles = np.linspace(0.1, 1.2, 6)
    assert fit_constant(angles, 1.1, mean_force(angles, 1.1, 5.0)) == pytest.approx(5.0)


def test_a_fin_that_pulls_has_no_constant():
    with pytest.raises(RunError, match=r"at 2\.1 Hz: the trials' mean force is -0\.5 N.*give another frequency"):
        fit_constant(np.array([0.5, 1.0]), 2.1, np.array([-0.25, -0.75]))


def test_amplitudes_in_the_wrong_order_are_refused():
    with pytest.raises(ConfigurationError, match=r"must not be above amplitude_max_rad = 1\.2"):
        InverseConfig.build({"amplitude_min_rad": 1.3})
