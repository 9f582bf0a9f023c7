"""Trains one policy per cell with LSTM-PPO, all in one compiled program.

The policies do not exchange data, so each policy depends only on its seed and cell. A resumed run
ends with the same weights as an uninterrupted run.
"""

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from softfin.core.compilation import jit
from softfin.core.errors import RunError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, check_power
from softfin.core.quantities import AXES, AnyArray, Limits
from softfin.core.randomness import named_key
from softfin.gaits.reachable import Cells, Reachable
from softfin.gaits.simulate import ReportSearch
from softfin.learning.configuration import TrainConfig, evaluation_references, training_cells
from softfin.learning.policy import Policy
from softfin.learning.ppo import PPO
from softfin.learning.rollout import AgentState, Metrics, PolicyEvaluation, evaluate_policy
from softfin.storage.run_directory import RunDirectory, read_training_log
from softfin.task.references import References, stack_references
from softfin.task.task import ForceTracking, TaskConfig

PerCell: TypeAlias = Float[np.ndarray, "cells"]
Checkpoint: TypeAlias = tuple[AgentState, Policy]
"""State of all agents, and the best policies so far."""
Candidates: TypeAlias = tuple[Policy, PolicyEvaluation]
"""Policies and their evaluations; leaves have a leading axis of cells."""


class TrainedPolicies(NamedTuple):
    """Policies of a finished run."""

    config: TrainConfig
    task: TaskConfig
    """Task of the configuration, scaled by the size of the fin."""
    cells: Cells
    reachable: Reachable
    limits: Limits
    policies: Policy
    """Policy with the lowest error in each cell; leaves ``(cells, ...)``."""
    references: Float[np.ndarray, "cells references 2"]
    """Evaluation references, each moved to the nearest reachable force [N]."""
    evaluation: PolicyEvaluation
    """Evaluation of these policies, ``(cells, references, 2)``."""
    log: list[JsonObject]
    """Metrics of each update, as means over the cells."""


def train_policies(
    plant: Plant,
    config: TrainConfig,
    reachable: Reachable,
    seed: int,
    run_directory: RunDirectory,
    report: ReportSearch = lambda *_: None,
) -> TrainedPolicies:
    """Train a policy for each reachable cell; resume from the checkpoint in `run_directory` if
    there is one.

    Raises:
        ConfigurationError: If the fin can reach none of the references.
        PlantError: If the power has a weight, but the plant does not provide the torque.
        RunError: If a loss or a force is not finite, or the disk is full.
    """
    check_power(plant, config.task.reward.power, "task.reward.power")
    limits = Limits(*map(float, plant.limits))
    cells = training_cells(config, reachable)
    task = config.task.scaled(reachable.size)
    fitted = config.model_copy(update={"task": task})
    references = evaluation_references(config, cells, reachable)
    keys = jnp.stack([named_key(seed, f"train/{cell}") for cell in cells])
    agents = _start(fitted, plant, keys, stack_references(cells, reachable))
    evaluate = partial(_evaluate, task, plant, references=jnp.asarray(references))
    best: Candidates | None = None
    num_completed = 0
    initial = (agents, agents.policy)
    resumed = run_directory.load(_without_keys(initial))
    if resumed is not None:
        agents, policies = _with_keys(resumed[0], initial)
        best = (policies, evaluate(policies))
        num_completed = resumed[1]["updates"]
    log = run_directory.log(rewind_to=num_completed * config.ppo.steps_per_update)
    for update in range(num_completed + 1, config.num_updates + 1):
        agents, metrics = _update(fitted, plant, agents)
        loss = np.asarray(metrics["loss"]) + np.asarray(metrics["gradient_norm"])
        _check_finite("the loss", loss, cells, update)
        means = _means(metrics)
        is_evaluated = _is_evaluated(config, update)
        if is_evaluated:
            evaluation = evaluate(agents.policy)
            _check_finite("the force in the evaluation", _errors(evaluation), cells, update)
            best = _better(best, (agents.policy, evaluation))
            means |= _means(_scores(evaluation))
        # Written before the checkpoint because a resumed run can remove surplus entries but not
        # restore missing ones.
        log.write(update * config.ppo.steps_per_update, **means)
        if is_evaluated:
            assert best is not None
            run_directory.save(_without_keys((agents, best[0])), {"updates": update})
        errors = "/".join(f"{means[f'error_{axis}_n']:.2g}" for axis in AXES)
        report(update / config.num_updates, f"error {errors} N while exploring")
    assert best is not None
    policies, evaluation = best
    entries = read_training_log(log.path)
    return TrainedPolicies(
        config, task, cells, reachable, limits, policies, references, evaluation, entries
    )


@jit("none")
def _start(
    config: TrainConfig, plant: Plant, keys: Key[Array, "cells"], references: References
) -> AgentState:
    return jax.vmap(_learner(config, plant).init)(keys, references)


@jit("low")
def _update(config: TrainConfig, plant: Plant, agents: AgentState) -> tuple[AgentState, Metrics]:
    return jax.vmap(_learner(config, plant).update)(agents)


@jit("low")
def _evaluate(
    task: TaskConfig, plant: Plant, policies: Policy, references: Array
) -> PolicyEvaluation:
    # The key is always the same so that policies from different updates and seeds can be compared.
    evaluate = partial(evaluate_policy, ForceTracking(plant, task), key=named_key(0, "score"))
    return jax.vmap(evaluate)(policies, references)


def _learner(config: TrainConfig, plant: Plant) -> PPO:
    task = ForceTracking(plant, config.task)
    return PPO(task, config.ppo, config.policy, config.num_updates)


def _without_keys(state: Checkpoint) -> Checkpoint:
    """Convert random keys to integers, because keys cannot be stored in files."""
    stored: Checkpoint = jax.tree.map(
        lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state
    )
    return stored


def _with_keys(stored: Checkpoint, like: Checkpoint) -> Checkpoint:
    """Convert integers back to random keys at the leaves where `like` has keys."""
    state: Checkpoint = jax.tree.map(
        lambda leaf, old: jax.random.wrap_key_data(leaf) if _is_key(old) else leaf, stored, like
    )
    return state


def _is_key(leaf: AnyArray) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _is_evaluated(config: TrainConfig, update: int) -> bool:
    """Return whether the policies are evaluated after an update; evaluations are evenly spaced and
    include the last update."""
    count = config.num_evaluations
    return update * count // config.num_updates > (update - 1) * count // config.num_updates


def _check_finite(what: str, values: PerCell, cells: Cells, update: int) -> None:
    for cell, value in zip(cells, values, strict=True):
        if not np.isfinite(value):
            raise RunError(
                f"train: {what} is NaN or infinite in update {update}, cell {cell}; lower "
                "ppo.learning_rate, or check the plant"
            )


def _better(best: Candidates | None, new: Candidates) -> Candidates:
    """For each cell, return the policy with the lower mean error, as NumPy arrays."""
    if best is None:
        best = new
    is_better = _errors(new[1]) < _errors(best[1])

    def choose(new: AnyArray, old: AnyArray) -> np.ndarray:
        return np.asarray(np.where(is_better.reshape(-1, *[1] * (new.ndim - 1)), new, old))

    chosen: Candidates = jax.tree.map(choose, new, best)
    return chosen


def _errors(evaluation: PolicyEvaluation) -> PerCell:
    """Return the mean error of each policy over its references and both axes [N]."""
    return np.asarray(np.asarray(evaluation.error).mean(axis=(1, 2)))


def _scores(evaluation: PolicyEvaluation) -> Metrics:
    """Return the mean error of each policy over its references and, for ensembles, the mean
    fraction of actions outside the training data."""
    x, y = np.moveaxis(np.asarray(evaluation.error).mean(axis=1), -1, 0)
    scores: Metrics = {"score_x_n": x, "score_y_n": y}
    if evaluation.out_of_distribution_fraction is not None:
        outside = np.asarray(evaluation.out_of_distribution_fraction)
        scores["score_out_of_distribution"] = outside.mean(axis=-1)
    return scores


def _means(metrics: Metrics) -> dict[str, float]:
    return {name: float(np.mean(values)) for name, values in metrics.items()}
