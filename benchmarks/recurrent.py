"""RecurrentPPO of sb3-contrib (extra ``sb3``), an LSTM-PPO other than softfin's, evaluated as
controllers are.

It learns through the Gymnasium environment with the library's defaults: two LSTMs of 256 units, 128
actions a rollout, 10 epochs.
"""

from typing import Any

import gymnasium
import numpy as np

from softfin.core.errors import ConfigurationError
from softfin.core.gym_registration import ID, register
from softfin.core.plant import Plant
from softfin.core.quantities import Limits
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, score_experiments
from softfin.evaluation.experiment import ExperimentRecording, run_together
from softfin.evaluation.predict import PolicyController
from softfin.gaits.reachable import Cell, bounding_box
from softfin.installation import how_to_add
from softfin.task.task import TaskConfig


def train_recurrent(plant: Plant, steps: int, seed: int, task: TaskConfig, references: Cell) -> Any:
    """Train a RecurrentPPO for `steps` actions in a plant, or a little more: its rollouts are
    whole.

    Raises ConfigurationError where sb3-contrib is not installed.
    """
    try:
        from sb3_contrib import RecurrentPPO
    except ImportError:
        raise ConfigurationError(f"sb3-contrib is not installed: {how_to_add('sb3')}") from None
    register()
    environment = gymnasium.make(ID, plant=plant, config=task, references=references)
    return RecurrentPPO("MlpLstmPolicy", environment, seed=seed, device="cpu").learn(steps)


def run_recurrent(
    model: Any, task: TaskConfig, limits: Limits, plant: Plant, config: EvaluateConfig
) -> ExperimentRecording:
    """Run the experiments of `config` with the model's mean actions, in the units of the `limits`
    that it learnt in."""
    experiments = [(np.asarray(config.references, np.float32), config.seconds)]
    controller = PolicyController(model, limits, task)
    return run_together(controller, plant, experiments, config.keys())[0]


def evaluate_recurrent(plant: Plant, config: EvaluateConfig, steps: int) -> Evaluation:
    """Train RecurrentPPO for all references of `config` in a plant, and evaluate it there."""
    task = TaskConfig()
    box = bounding_box([Cell.around(reference, 0.0) for reference in config.references])
    model = train_recurrent(plant, steps, config.seed, task, box)
    recording = run_recurrent(model, task, Limits(*plant.limits), plant, config)
    return score_experiments(recording, plant, config)
