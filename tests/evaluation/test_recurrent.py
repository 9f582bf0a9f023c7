import importlib.util

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.recurrent import run_recurrent, train_recurrent

from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS, action_to_command
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.evaluation.experiment import run
from softfin.task.references import PAPER_RANGE
from softfin.task.task import TaskConfig, observation, remember, rest_actions
from tests.plants import AnalyticFin, MisreadFin

CONFIG = EvaluateConfig(references=((1, -1), (2, 0)), seconds=3, seeds=2)
TASK = TaskConfig()
GAINS = np.random.default_rng(0).normal(size=(2, 11)).astype(np.float32)


class Model:
    """Predicts as a model of sb3 does; its memory counts the actions since the start."""

    def predict(self, seen, state, episode_start, deterministic):
        assert deterministic
        assert episode_start.all() == (state is None)
        age = np.zeros(len(seen), np.float32) if state is None else state
        return np.tanh(seen @ GAINS.T + np.cos(age)[:, None]), age + 1


class Same(eqx.Module):
    """The same rule as a controller."""

    def init(self):
        return rest_actions(TASK, PAPER_LIMITS), jnp.int32(0)

    def act(self, state, measured, reference):
        actions, age = state
        action = jnp.tanh(
            GAINS @ observation(TASK, measured.angle, reference, actions) + jnp.cos(age)
        )
        return (remember(actions, action), age + 1), action_to_command(PAPER_LIMITS, action)

    def check(self, reference):
        """Covers everything."""


def test_a_model_outside_jax_meets_the_experiment_that_a_controller_meets():
    plant = AnalyticFin(noise_n=0.1)
    ours = run_recurrent(Model(), TASK, PAPER_LIMITS, plant, CONFIG)
    theirs = run(
        Same(), plant, np.asarray(CONFIG.references, np.float32), CONFIG.seconds, CONFIG.keys()
    )
    assert ours.reading.force.shape == (2, 2, 300, 2)
    np.testing.assert_allclose(ours.command.angle, theirs.command.angle, atol=1e-3)
    np.testing.assert_allclose(ours.reading.force, theirs.reading.force, atol=1e-2)
    assert float(np.abs(np.diff(ours.command.angle)).sum()) > 1


def test_the_true_force_is_recorded_where_the_plant_knows_it():
    recording = run_recurrent(Model(), TASK, PAPER_LIMITS, MisreadFin(), CONFIG)
    assert recording.true_force.shape == (2, 2, 300, 2)
    np.testing.assert_allclose(
        (recording.reading.force - recording.true_force)[..., 0], 0.4, atol=1e-5
    )


@pytest.mark.skipif(
    importlib.util.find_spec("sb3_contrib") is not None, reason="the extra sb3 is installed"
)
def test_without_the_extra_it_says_how_to_install_it():
    with pytest.raises(
        ConfigurationError, match=r"sb3-contrib is not installed: .*pip install .*\[sb3\]"
    ):
        train_recurrent(AnalyticFin(), 128, 0, TASK, PAPER_RANGE)


@pytest.mark.slow
def test_recurrent_ppo_is_trained_and_evaluated():
    pytest.importorskip(
        "sb3_contrib", reason="the extra sb3 is not installed: 5 GB, which CI leaves out"
    )
    model = train_recurrent(AnalyticFin(), 128, 0, TASK, PAPER_RANGE)
    recording = run_recurrent(model, TASK, PAPER_LIMITS, AnalyticFin(), CONFIG)
    assert np.isfinite(recording.reading.force).all()
