"""RecurrentPPO of sb3-contrib (extra ``sb3``), an LSTM-PPO other than softfin's, evaluated as
controllers are.

It learns through the Gymnasium environment with the library's defaults: two LSTMs of 256 units, 128
actions a rollout, 10 epochs. It lives outside JAX, so all experiments go through it in lock step,
action by action.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError
from softfin.core.gym_registration import ID, register
from softfin.core.plant import Plant, State, Ticks, hold_action_with_hidden
from softfin.core.quantities import Limits, action_to_command
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, score_experiments
from softfin.evaluation.experiment import ExperimentRecording, RecordedTicks
from softfin.gaits.reachable import Cell, bounding_box
from softfin.installation import how_to_add
from softfin.task.task import TaskConfig, observation, remember, rest_actions


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
    references = np.repeat(np.asarray(config.references, np.float32), config.seeds, axis=0)
    count = len(references)

    @jax.jit
    def observe(angle: Float[Array, "runs"], actions: Float[Array, "runs remembered 2"]) -> Array:
        return jax.vmap(lambda *observed: observation(task, *observed))(
            angle, jnp.asarray(references), actions
        )

    def hold(state: State, action: Float[Array, "2"], ticks: Ticks) -> tuple[State, RecordedTicks]:
        command = action_to_command(limits, action)
        state, (reading, hidden) = hold_action_with_hidden(
            plant, state, command, ticks, PAPER_CLOCK.max_ticks
        )
        return state, (
            jax.tree.map(lambda x: jnp.full(PAPER_CLOCK.max_ticks, x), command),
            reading,
            hidden.true_force,
        )

    advance = jax.jit(jax.vmap(hold, (0, 0, None)))
    state = jax.vmap(plant.init)(jnp.tile(config.keys(), len(config.references)))
    angle = jnp.zeros(count)
    actions = jnp.tile(rest_actions(task, limits), (count, 1, 1))
    memory = None
    kept = []
    held = PAPER_CLOCK.action_ticks(config.seconds * len(PAPER_CLOCK.ticks))
    for age, ticks in enumerate(held):
        observed = np.asarray(observe(angle, actions))
        starts = np.full(count, age == 0)
        predicted, memory = model.predict(
            observed, state=memory, episode_start=starts, deterministic=True
        )
        action = jnp.asarray(predicted, jnp.float32)
        state, recorded = advance(state, action, ticks)
        angle = recorded[1].angle[:, ticks - 1]
        actions = jax.vmap(remember)(actions, action)
        kept.append(jax.tree.map(np.asarray, recorded))

    def together(*parts: Any) -> Any:
        whole = np.concatenate(parts, axis=1)[:, PAPER_CLOCK.valid_rows(len(held))]
        return whole.reshape(len(config.references), config.seeds, *whole.shape[1:])

    return ExperimentRecording(
        np.asarray(config.references, np.float32), *jax.tree.map(together, *kept)
    )


def evaluate_recurrent(plant: Plant, config: EvaluateConfig, steps: int) -> Evaluation:
    """Train RecurrentPPO for all references of `config` in a plant, and evaluate it there."""
    task = TaskConfig()
    box = bounding_box([Cell.around(reference, 0.0) for reference in config.references])
    model = train_recurrent(plant, steps, config.seed, task, box)
    recording = run_recurrent(model, task, Limits(*plant.limits), plant, config)
    return score_experiments(recording, plant, config)
