import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError, RunError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.evaluation.baselines.open_loop import (
    InverseConfig,
    OpenLoopSearch,
    SearchConfig,
    ShaftSine,
    inverse,
)
from tests.plants import AnalyticFin

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
    """About 1.2 rad, 0.6 rad: beyond 1.5 rad while the sine is above a half, a third of the
    time."""
    command, angle, _ = one(1.2, 0.6, 0.5).commands(LIMITS, 200)
    assert float(command.angle.max()) == pytest.approx(1.5)
    assert float(angle) == pytest.approx(1 / 3, abs=0.011)


def test_each_tick_that_is_too_fast_is_counted():
    """A greatest speed of 6 rad/s under a limit of 3: too fast while the cosine is above a half,
    two thirds of it."""
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


def amplitude_for(force_n, frequency_hz):
    free = InverseConfig(amplitude_min_rad=0, amplitude_max_rad=np.pi)
    return inverse(np.array([[force_n, 0.0]]), frequency_hz, PAPER_LIMITS, free, free.constant)[
        0
    ].amplitude[0]


@pytest.mark.parametrize(
    ("force_n", "frequency_hz", "amplitude_rad"),
    # A right angle takes K f^2, 60 degrees take half of that.
    [
        (10.44599, 2.1, np.pi / 2),
        (5.222995, 2.1, np.pi / 3),
        (2.866133, 1.1, np.pi / 2),
        (0.0, 1.1, 0.0),
    ],
)
def test_the_amplitude_has_its_known_values(force_n, frequency_hz, amplitude_rad):
    assert amplitude_for(force_n, frequency_hz) == pytest.approx(amplitude_rad, abs=1e-5)


@given(st.floats(0.0, 20.0), st.floats(0.5, 4.0))
def test_the_force_of_the_amplitude_for_a_force_is_that_force(force, frequency):
    most = 2 * CONFIG.constant * frequency**2
    found = CONFIG.constant * frequency**2 * (1 - np.cos(amplitude_for(force, frequency)))
    assert found == pytest.approx(min(force, most), abs=1e-6)


def test_a_force_towards_minus_y_is_made_at_a_positive_angle():
    centre = sines((0, -1), (1, -1), (2, 0), (1, 1), (0, 1))[0].centre
    np.testing.assert_allclose(centre, [np.pi / 2, np.pi / 4, 0, -np.pi / 4, -np.pi / 2])


def test_amplitudes_are_kept_within_the_drivers_range_and_marked():
    found, limited = sines((2, 0), (0.01, 0), (30, 0))
    assert [row["amplitude_limited"] for row in limited] == [False, True, True]
    np.testing.assert_allclose(found.amplitude[1:], [0.1, 1.2])


def test_a_direction_that_the_plant_cannot_take_is_kept_at_its_edge_and_marked():
    found, limited = sines((-1, -1), (1, -1))
    assert [row["direction_limited"] for row in limited] == [True, False]
    assert found.centre[0] == PAPER_LIMITS.angle_max


class Obedient(OpenLoopSearch):
    """A fin whose mean forces are those of the model, with a constant of its own."""

    gain = 5.0

    def forces_of_sines(self, sines):
        _, amplitude, frequency = sines.T
        force = self.gain * frequency**2 * (1 - np.cos(amplitude))
        return np.repeat(np.stack([force, 0 * force], axis=1)[:, None], 300, axis=1)


def test_recalibration_finds_the_constant_of_a_fin_that_obeys_the_model():
    fin = Obedient(AnalyticFin(), PAPER_LIMITS, SearchConfig(), 0)
    assert fin.fitted_constant(1.1, (0.1, 1.2)) == pytest.approx(5.0)


@pytest.mark.parametrize(("low", "high"), [(0.2, 1.2), (-1.5, -0.3)])
def test_a_fin_that_cannot_reach_angle_0_has_no_constant(low, high):
    fin = Obedient(AnalyticFin(), Limits(low, high, 1.0, 3.0), SearchConfig(), 0)
    with pytest.raises(RunError, match=rf"strokes about angle 0, .* are {low} to {high} rad; use"):
        fin.fitted_constant(1.1, (0.1, 1.2))


def test_a_fin_that_pulls_has_no_constant():
    fin = Obedient(AnalyticFin(), PAPER_LIMITS, SearchConfig(trials=1), 0)
    fin.gain = -1.0
    with pytest.raises(
        RunError,
        match=r"at 2\.1 Hz: the mean force of the trials is -0\.54 N.*use another frequency",
    ):
        fin.fitted_constant(2.1, (0.5, 1.0))


def test_amplitudes_in_the_wrong_order_are_refused():
    with pytest.raises(
        ConfigurationError, match=r"must not be greater than amplitude_max_rad = 1\.2"
    ):
        InverseConfig.build({"amplitude_min_rad": 1.3})
