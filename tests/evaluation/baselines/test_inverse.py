import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError, RunError
from softfin.core.quantities import PAPER_LIMITS
from softfin.evaluation.baselines.inverse import InverseConfig, amplitude, inverse, mean_force, recalibrated

CONFIG = InverseConfig()


def beats(*forces, frequency=2.1, constant=CONFIG.constant):
    return inverse(np.array(forces, np.float64), frequency, PAPER_LIMITS, CONFIG, constant)


def test_the_constant_is_that_of_the_u_cat_fins():
    assert CONFIG.constant == pytest.approx(0.24 * np.pi**2, rel=1e-12)


@pytest.mark.parametrize(
    ("force_n", "frequency_hz", "amplitude_rad"),
    # A right angle takes K f^2, 60 degrees take half of that.
    [(10.44599, 2.1, np.pi / 2), (5.222995, 2.1, np.pi / 3), (2.866133, 1.1, np.pi / 2), (0.0, 1.1, 0.0)],
)
def test_the_amplitude_has_its_known_values(force_n, frequency_hz, amplitude_rad):
    assert amplitude(np.array(force_n), frequency_hz, CONFIG.constant) == pytest.approx(amplitude_rad, abs=1e-5)


@given(st.floats(0.0, 20.0), st.floats(0.5, 4.0))
def test_the_force_of_the_amplitude_for_a_force_is_that_force(force, frequency):
    most = 2 * CONFIG.constant * frequency**2
    found = mean_force(amplitude(np.array(force), frequency, CONFIG.constant), frequency, CONFIG.constant)
    assert float(found) == pytest.approx(min(force, most), abs=1e-6)


def test_a_force_towards_minus_y_is_made_at_a_positive_angle():
    centre = beats((0, -1), (1, -1), (2, 0), (1, 1), (0, 1)).sine.centre
    np.testing.assert_allclose(centre, [np.pi / 2, np.pi / 4, 0, -np.pi / 4, -np.pi / 2])


def test_amplitudes_are_kept_within_the_drivers_range_and_said_to_be():
    found = beats((2, 0), (0.01, 0), (30, 0))
    np.testing.assert_array_equal(found.amplitude_clipped, [False, True, True])
    np.testing.assert_allclose(found.sine.amplitude[1:], [0.1, 1.2])


def test_a_direction_that_the_plant_cannot_take_is_kept_at_its_edge_and_said_to_be():
    found = beats((-1, -1), (1, -1))
    np.testing.assert_array_equal(found.direction_clipped, [True, False])
    assert found.sine.centre[0] == PAPER_LIMITS.angle_max


def test_recalibration_finds_the_constant_of_a_fin_that_obeys_the_model():
    angles = np.linspace(0.1, 1.2, 6)
    assert recalibrated(angles, 1.1, mean_force(angles, 1.1, 5.0)) == pytest.approx(5.0)


def test_a_fin_that_pulls_has_no_constant():
    with pytest.raises(RunError, match=r"at 2\.1 Hz: the trials' mean force is -0\.5 N.*give another frequency"):
        recalibrated(np.array([0.5, 1.0]), 2.1, np.array([-0.25, -0.75]))


def test_amplitudes_in_the_wrong_order_are_refused():
    with pytest.raises(ConfigurationError, match=r"must not be above amplitude_max_rad = 1\.2"):
        InverseConfig.build({"amplitude_min_rad": 1.3})
