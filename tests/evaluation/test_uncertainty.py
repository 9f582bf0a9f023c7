import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.core.window import moving_average
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.experiment import ExperimentRecording, run
from softfin.evaluation.scores import SurrogateUncertainty, score_uncertainty
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


def test_a_plant_that_does_not_estimate_its_errors_has_no_uncertainty(recording):
    assert score_uncertainty(AnalyticFin(), recording) is None


def test_the_half_width_is_that_of_the_members_own_means_over_the_recorded_commands(recording):
    plant = small.surrogate()
    uncertainty = score_uncertainty(plant, recording)
    commands = Command(*(jnp.asarray(part[1, 0]) for part in recording.command))
    force = []
    state = plant.init(jax.random.key(0))
    # Compiled once: outside a program each call would be compiled anew, and all of them kept.
    advance = jax.jit(lambda state, command: plant.advance_members(state, command, 1))
    for tick in range(commands.angle.size):
        state, each = advance(state, Command(*(part[tick] for part in commands)))
        force.append(np.asarray(each.force[:, 0]))
    means = moving_average(np.stack(force, axis=1))
    np.testing.assert_allclose(
        uncertainty.half_width[1], plant.interval.half_width(means).mean(axis=0), rtol=1e-3
    )
    again = roll(plant, plant.init(jax.random.key(0)), commands)[1]
    np.testing.assert_allclose(again.force, recording.reading.force[1, 0], atol=1e-4)


@pytest.mark.parametrize(("limit", "share"), [(1e-3, 1.0), (1e3, 0.0)])
def test_samples_beyond_the_data_are_counted(recording, limit, share):
    uncertainty = score_uncertainty(fitted_within(limit), recording)
    np.testing.assert_array_equal(uncertainty.out_of_distribution_fraction, [share, share])
    assert (uncertainty.furthest > 1).all() == (share == 1)


def test_a_warning_carries_the_numbers_and_comes_above_one_percent():
    of = {"furthest": np.array([0.9, 2.34]), "half_width": np.zeros((2, 2))}
    assert (
        SurrogateUncertainty(out_of_distribution_fraction=np.array([0.0, 0.019]), **of).warning()
        is None
    )
    warning = SurrogateUncertainty(
        out_of_distribution_fraction=np.array([0.0, 0.05]), **of
    ).warning()
    assert "2.5% of the samples" in warning
    assert "up to 2.3" in warning


def test_an_evaluation_in_a_surrogate_has_its_uncertainty():
    config = EvaluateConfig(references=((1.0, 0.0),), seconds=3, seeds=2)
    summary = score_controller(Echo(), fitted_within(1e-3), config).summary()
    assert summary["references"][0]["surrogate"]["out_of_distribution_fraction"] == 1
    assert summary["references"][0]["surrogate"]["half_width_x_n"] > 0
    assert "100.0% of the samples" in summary["warning"]
    other = score_controller(Echo(), AnalyticFin(), config).summary()
    assert other["warning"] is None
    assert "surrogate" not in other["references"][0]
