import jax
import numpy as np
import pytest
from studies.open_loop import (
    CHUNK,
    UCAT_CONSTANT_N_S2,
    OpenLoopSearch,
    ShaftSine,
    force_errors,
    inverse,
    repeated,
)

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import RunError
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from tests.plants import AnalyticFin, PlainFin

LIMITS = Limits(-1.5, 1.5, 1.0, 3.0)


def sine(centre, amplitude, frequency):
    return ShaftSine(np.float64(centre), np.float64(amplitude), np.float64(frequency))


def searching(seed=0, gain=0.5, **changes):
    fin = AnalyticFin(gain=gain, noise_n=0.0)
    small = {"seconds": 4, "centres": 5, "amplitudes": 3, "kept": 2, "refinements": 1, "gaits": 40}
    return OpenLoopSearch(fin, PAPER_LIMITS, seed, **(small | changes))


def test_the_target_follows_the_sine_one_tick_ahead():
    command = sine(0.3, 0.2, 1.0).commands(LIMITS, 100)
    time = (np.arange(100) + 1) / 100
    np.testing.assert_allclose(command.angle, 0.3 + 0.2 * np.sin(2 * np.pi * time), atol=1e-5)


@pytest.mark.parametrize(
    ("amplitude", "velocity"), [(0.3, 2 * np.pi * 0.3), (0.1, 1.0), (1.0, 3.0)]
)
def test_the_velocity_is_the_largest_of_the_sine_within_the_limits(amplitude, velocity):
    command = sine(0.0, amplitude, 1.0).commands(LIMITS, 10)
    np.testing.assert_allclose(command.velocity, velocity, rtol=1e-6)


def test_the_inverse_model_has_its_known_amplitudes():
    """A right angle takes K f^2, 60 degrees take half of that."""
    forces = np.array([[5.222995, 0], [0.01, 0], [30.0, 0]])
    amplitude = inverse(forces, 2.1, PAPER_LIMITS).amplitude
    np.testing.assert_allclose(amplitude, [np.pi / 3, 0.1, 1.2], atol=1e-5)
    assert pytest.approx(0.24 * np.pi**2) == UCAT_CONSTANT_N_S2


def test_the_inverse_model_makes_a_force_towards_minus_y_at_a_positive_angle():
    forces = np.array([(0, -1), (1, -1), (2, 0), (1, 1), (-1, -1)], float)
    centre = inverse(forces, 1.1, PAPER_LIMITS).centre
    expected = [np.pi / 2, np.pi / 4, 0, -np.pi / 4, PAPER_LIMITS.angle_max]
    np.testing.assert_allclose(centre, expected)


def test_forces_of_more_cases_than_run_side_by_side_are_those_one_by_one():
    sines = ShaftSine(
        np.linspace(-1, 1, CHUNK + 3), np.full(CHUNK + 3, 0.4), np.full(CHUNK + 3, 1.0)
    )
    commands = jax.tree.map(np.asarray, sines.commands(PAPER_LIMITS, 50))
    search = OpenLoopSearch(PlainFin(), PAPER_LIMITS, 0)
    forces = search.forces(commands)
    assert forces.shape == (CHUNK + 3, 50, 2)
    last = search.forces(jax.tree.map(lambda x: x[-1:], commands))
    np.testing.assert_allclose(forces[-1:], last, atol=1e-6)


def test_the_force_error_is_the_sum_of_both_errors_over_whole_windows():
    forces = np.zeros((2, 400, 2))
    forces[1, :, 0] = 1.5
    np.testing.assert_allclose(
        force_errors(forces, np.array([[1.0, -1.0], [1.5, 0.0]])), [[2.0, 1.5], [1.5, 0.0]]
    )


def test_each_round_refines_the_sine_for_each_reference(monkeypatch):
    monkeypatch.setattr("studies.open_loop.FREQUENCIES_HZ", (1.0,))
    references = np.array([(0.6, -0.5), (0.8, 0.1)])

    def losses(refinements):
        search = searching(refinements=refinements)
        forces = search.forces_of_sines(np.stack(search.best_sines(references), axis=1))
        return np.diag(force_errors(forces, references))

    assert (losses(3) < 0.5 * losses(0)).all()


def test_a_gait_is_six_actions_on_the_clock_repeated():
    command = repeated(Command(np.arange(6.0), np.arange(6.0) + 1), 5)
    assert command.angle.shape == (500,)
    starts = np.concatenate([[0], np.cumsum(PAPER_CLOCK.ticks * 2)])
    for i in range(6):
        np.testing.assert_array_equal(command.angle[starts[i] : starts[i + 1]], i)
    np.testing.assert_array_equal(command.angle[400:], command.angle[:100])


def test_more_gaits_are_never_worse_and_depend_on_the_seed():
    references = np.array([(1.0, -1.0), (1.5, 0.0)])
    gaits = searching().best_gaits(references)
    assert not np.array_equal(gaits.angle, searching(seed=1).best_gaits(references).angle)
    many, few = (
        np.diag(force_errors(searching().forces(repeated(found, 4)), references))
        for found in (gaits, searching(gaits=1).best_gaits(references))
    )
    assert (many <= few).all()


def test_a_stronger_fin_has_a_larger_constant():
    constants = [searching(gain=gain).fitted_constant(1.0) for gain in (0.5, 1.0)]
    assert constants[1] == pytest.approx(2 * constants[0], rel=1e-3)


def test_a_fin_that_pulls_has_no_constant():
    with pytest.raises(RunError, match="against the zero direction"):
        searching(gain=-0.5).fitted_constant(1.0)
