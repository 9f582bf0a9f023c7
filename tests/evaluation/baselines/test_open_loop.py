import jax
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import PlantError
from softfin.core.quantities import PAPER_LIMITS, Command
from softfin.evaluation.baselines.baselines import evaluate_commands
from softfin.evaluation.baselines.open_loop import (
    CHUNK,
    OpenLoopSearch,
    SearchConfig,
    ShaftSine,
    force_errors,
)
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.tank import Tank
from tests.plants import AnalyticFin, Flapper, PlainFin

CONFIG = EvaluateConfig(references=((1, -1), (2, 0)), seconds=4, seeds=3)


def flapping(seconds):
    """What `Flapper` commands, tick by tick."""
    sides = np.resize([0.8, -0.8], seconds * 3)
    angle = np.repeat(sides, np.resize(PAPER_CLOCK.ticks, seconds * 3)).astype(np.float32)
    return Command(angle, np.full_like(angle, 3.0))


def test_the_same_commands_score_the_same_as_from_a_controller():
    plant = AnalyticFin(noise_n=0.3)
    commands = jax.tree.map(lambda x: np.stack([x, x]), flapping(4))
    ours = evaluate_commands(plant, commands, CONFIG)
    theirs = score_controller(Flapper(), plant, CONFIG)
    jax.tree.map(
        lambda mine, other: np.testing.assert_allclose(mine, other, atol=1e-4),
        ours.scores,
        theirs.scores,
    )
    np.testing.assert_array_equal(ours.recording.command.angle, theirs.recording.command.angle)
    assert ours.summary().keys() == theirs.summary().keys()


def test_a_plant_without_randomness_counts_as_one_repetition():
    commands = jax.tree.map(lambda x: np.stack([x, x]), flapping(4))
    assert evaluate_commands(AnalyticFin(noise_n=0.0), commands, CONFIG).repetitions == 1


def test_forces_of_more_cases_than_run_side_by_side_are_those_one_by_one():
    sines = ShaftSine(
        np.linspace(-1, 1, CHUNK + 3), np.full(CHUNK + 3, 0.4), np.full(CHUNK + 3, 1.0)
    )
    commands = jax.tree.map(np.asarray, sines.commands(PAPER_LIMITS, 50)[0])
    search = OpenLoopSearch(PlainFin(), PAPER_LIMITS, SearchConfig(), 0)
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


def test_a_force_that_is_no_number_is_named():
    class Broken(PlainFin):
        def advance(self, state, command, ticks):
            state, reading = super().advance(state, command, ticks)
            return state, reading._replace(force=reading.force / 0)

    commands = jax.tree.map(lambda x: np.stack([x, x]), flapping(4))
    with pytest.raises(PlantError, match=r"reference \(1, -1\) N, seed 0, 0\.01 s"):
        evaluate_commands(Broken(), commands, CONFIG)


def test_in_the_tank_a_sine_about_a_positive_angle_pushes_towards_minus_y():
    """The frame of the inverse model is the tank's: about pi/4 the mean force is along (1, -1)."""
    tank = Tank()
    sines = ShaftSine(np.array([0.7854, -0.7854]), np.full(2, 0.7), np.full(2, 1.0))
    commands = jax.tree.map(np.asarray, sines.commands(tank.limits, 300)[0])
    config = EvaluateConfig(references=((1, -1), (1, 1)), seconds=3, seeds=1)
    force = (
        evaluate_commands(tank, commands, config).recording.reading.force[:, 0, 100:].mean(axis=1)
    )
    np.testing.assert_allclose(force, [[1, -1], [1, 1]], atol=0.25)
