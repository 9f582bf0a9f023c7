import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.experiment import ExperimentRecording, run
from softfin.evaluation.scores import data_distance, outside_fraction, outside_warning
from softfin.surrogate.streaming.ensemble import Familiarity
from tests.evaluation.test_experiment import Echo
from tests.plants import AnalyticFin
from tests.surrogate.streaming import small

REFERENCES = np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)


@pytest.fixture(scope="module")
def recording():
    whole = run(Echo(), small.surrogate(), REFERENCES, 3, jax.random.split(jax.random.key(0), 1))
    return ExperimentRecording(*jax.tree.map(np.asarray, tuple(whole)))


def fitted_within(limit):
    """The surrogate with data that lie within so much of nothing remembered."""
    plant = small.surrogate()
    size = plant.familiarity.mean.size
    return eqx.tree_at(
        lambda p: p.familiarity, plant, Familiarity(jnp.zeros(size), jnp.eye(size) / limit)
    )


def test_a_plant_that_does_not_estimate_its_errors_has_no_distance(recording):
    assert data_distance(AnalyticFin(), recording) is None


@pytest.mark.parametrize(("limit", "share"), [(1e-3, 1.0), (1e3, 0.0)])
def test_samples_beyond_the_data_are_counted(recording, limit, share):
    distance = data_distance(fitted_within(limit), recording)
    assert distance.shape == recording.command.angle[:, 0].shape
    assert outside_fraction(distance) == share


def test_the_distance_is_that_after_each_recorded_command(recording):
    plant = fitted_within(1.0)
    distance = data_distance(plant, recording)
    commands = Command(*(jnp.asarray(part[1, 0]) for part in recording.command))
    state, _ = roll(plant, plant.init(jax.random.key(0)), commands)
    assert distance[1, -1] == pytest.approx(float(plant.distance(state)), rel=1e-3)


def test_a_warning_carries_the_numbers_and_comes_above_one_percent():
    distance = np.full((2, 1000), 0.9)
    distance[1, :19] = 2.34
    assert outside_warning(distance) is None
    distance[1, :50] = 2.34
    warning = outside_warning(distance)
    assert "2.5% of the samples" in warning
    assert "up to 2.3" in warning


def test_an_evaluation_in_a_surrogate_has_its_uncertainty():
    config = EvaluateConfig(references=((1.0, 0.0),), seconds=3, seeds=2)
    summary = score_controller(Echo(), fitted_within(1e-3), config).summary()
    assert summary["references"][0]["surrogate"]["out_of_distribution_fraction"] == 1
    assert summary["references"][0]["surrogate"]["furthest"] > 1
    assert "100.0% of the samples" in summary["warning"]
    other = score_controller(Echo(), AnalyticFin(), config).summary()
    assert other["warning"] is None
    assert "surrogate" not in other["references"][0]
