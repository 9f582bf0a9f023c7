"""Runs all agents of a training run in one compiled program, on all devices of the machine.

There is an agent for each combination of seed and cell. Agents do not exchange data, so devices do
not communicate.
"""

from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, Key, PRNGKeyArray

from softfin.core.compilation import jit
from softfin.core.errors import RunError
from softfin.core.plant import EnsemblePlant, Plant, State
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AXES, Command, Limits, Reading
from softfin.core.randomness import named_key
from softfin.gaits.gait import FinForces, GaitTable
from softfin.gaits.reachable import Reachable, force_decimals
from softfin.learning.configuration import TrainConfig
from softfin.learning.gradient import Gradient
from softfin.learning.policy import Policy
from softfin.learning.ppo import PPO
from softfin.learning.rollout import AgentState, Metrics, PolicyEvaluation, evaluate_policy
from softfin.task.references import References, stack_references
from softfin.task.task import ForceTracking, TaskConfig

AgentTree = TypeVar("AgentTree")


class RunState(NamedTuple):
    """Checkpoint of a run; all leaves have a leading axis of agents."""

    agents: AgentState
    best: Policy
    """Policy with the lowest error so far, for each agent."""
    best_evaluation: PolicyEvaluation
    """Evaluation of `best`, ``(agents, references, 2)``."""


BestPolicies: TypeAlias = tuple[Policy, PolicyEvaluation]
"""Each agent's policy with the lowest deterministic error, and its evaluation; leaves ``(seeds,
cells, ...)``."""


class TrainingResult(NamedTuple):
    """Policies of a finished run."""

    config: TrainConfig
    limits: Limits
    seeds: tuple[int, ...]
    policies: Policy
    """Each agent's policy with the lowest deterministic error; leaves ``(seeds, cells, ...)``."""
    evaluation: PolicyEvaluation
    """Evaluation of these policies, ``(seeds, cells, references, 2)``."""
    reachable: Reachable | None = None
    """Mean forces that the fin can produce, if known."""


MemberState: TypeAlias = tuple[Int[Array, ""], State]
"""Index of a member and its state."""


class OneMember(eqx.Module):
    """A plant in which each fin is a random member of an ensemble, so that a policy cannot exploit
    the errors of a single model.

    The member is drawn at `init` and does not change during an episode; its index is part of the
    state.
    """

    ensemble: EnsemblePlant

    @property
    def limits(self) -> Limits:
        """Limits of the ensemble."""
        return self.ensemble.limits

    def init(self, key: PRNGKeyArray) -> MemberState:
        """Return a random member at rest."""
        index = jax.random.randint(key, (), 0, self.ensemble.size)
        return index, self.ensemble.member(index).init(jax.random.fold_in(key, 1))

    def advance(
        self, state: MemberState, command: Command, ticks: int
    ) -> tuple[MemberState, Reading]:
        """Hold the command for `ticks` samples."""
        index, inner = state
        inner, reading = self.ensemble.member(index).advance(inner, command, ticks)
        return (index, inner), reading


def _learner(config: TrainConfig, plant: Plant, table: GaitTable | None) -> PPO | Gradient:
    if config.ensemble == "each" and isinstance(plant, EnsemblePlant):
        plant = OneMember(plant)
    task = ForceTracking(plant, config.task)
    if config.algorithm == "ppo":
        return PPO(task, config.ppo, config.policy, config.num_updates)
    return Gradient(task, config.gradient, config.policy, config.num_updates, table)


@jit("none")
def _init(
    config: TrainConfig,
    plant: Plant,
    table: GaitTable | None,
    keys: Key[Array, "agents"],
    boxes: References,
) -> AgentState:
    return jax.vmap(_learner(config, plant, table).init)(keys, boxes)


@jit("low")
def _update(config: TrainConfig, plant: Plant, agents: AgentState) -> tuple[AgentState, Metrics]:
    # Only `init` needs the table of gaits; afterwards the policy contains it.
    return jax.vmap(_learner(config, plant, None).update)(agents)


@jit("low")
def _evaluate(
    task: TaskConfig, plant: Plant, policies: Policy, references: Array
) -> PolicyEvaluation:
    # The key is always the same, so that policies of different updates and seeds can be compared.
    evaluate = partial(evaluate_policy, ForceTracking(plant, task), key=named_key(0, "score"))
    return jax.vmap(evaluate)(policies, references)


class TrainingRun:
    """The compiled programs of a training run and their arguments, for all agents."""

    def __init__(
        self,
        plant: Plant,
        config: TrainConfig,
        seeds: tuple[int, ...],
        forces: FinForces | None,
    ) -> None:
        self.config = config
        self.seeds = seeds
        self.gaits = None if forces is None else forces.gaits
        self.reachable = None if forces is None else forces.reachable
        self.agents = [(seed, cell) for seed in seeds for cell in config.cells]
        self.plant = jit_argument(plant)
        # The configuration is a static argument. Without cells, runs that differ only in their
        # cells and seeds share compiled programs.
        self.compiled = config.model_copy(update={"cells": ()})
        self.references = jnp.asarray(
            np.tile(config.evaluation_references(self.reachable), (len(seeds), 1, 1))
        )

    def start(self) -> RunState:
        """Return the state of new agents, without evaluation."""
        # The key of an agent depends only on its seed and cell, so results do not depend on the
        # other agents of the run.
        keys = jnp.stack([named_key(seed, f"train/{cell}") for seed, cell in self.agents])
        boxes = stack_references(
            [cell.expanded(self.config.margin_n) for _, cell in self.agents], self.reachable
        )
        table = self.gaits if self.config.begins_as_gaits else None
        agents = _init(self.compiled, self.plant, table, *self.over_devices((keys, boxes)))
        # The first evaluation is always better.
        worst = np.full(self.references.shape, np.inf, np.float32)
        outside = worst[..., 0] if isinstance(self.plant, EnsemblePlant) else None
        return RunState(agents, agents.policy, PolicyEvaluation(worst, worst, outside))

    def over_devices(self, tree: AgentTree) -> AgentTree:
        """Distribute a tree with a leading axis of agents over the largest number of devices that
        divides the number of agents."""
        devices = jax.devices()
        used = max(count for count in range(1, len(devices) + 1) if len(self.agents) % count == 0)
        if used == 1:
            return tree
        mesh = Mesh(np.array(devices[:used]), ("devices",))
        parts = NamedSharding(mesh, PartitionSpec("devices"))  # type: ignore[no-untyped-call]
        return cast(AgentTree, jax.device_put(tree, parts))

    def update(self, agents: AgentState, number: int) -> tuple[AgentState, Metrics]:
        """Run update `number` for all agents.

        Raises:
            RunError: a loss or its gradient is not finite.
        """
        agents, metrics = _update(self.compiled, self.plant, agents)
        self._check_finite(
            "the loss", np.asarray(metrics["loss"]) + np.asarray(metrics["gradient_norm"]), number
        )
        return agents, metrics

    def evaluate(self, policies: Policy, update: int) -> PolicyEvaluation:
        """Evaluate the policies of all agents without exploration or sensing noise.

        Raises:
            RunError: a plant force is not finite.
        """
        # Sensing noise is used only in training: the best policy is chosen under the conditions of
        # `softfin evaluate`.
        without_noise = self.config.task.sensing.model_copy(update={"noise_rad": 0.0})
        task = self.config.task.model_copy(update={"sensing": without_noise})
        evaluation = _evaluate(task, self.plant, policies, self.references)
        errors = np.asarray(evaluation.error).sum(axis=(1, 2))
        self._check_finite("the force in the evaluation", errors, update)
        return evaluation

    def _check_finite(self, what: str, of_agents: np.ndarray, update: int) -> None:
        bad = np.flatnonzero(~np.isfinite(of_agents))
        if bad.size:
            seed, cell = self.agents[bad[0]]
            raise RunError(
                f"train: {what} is NaN or infinite in update {update} of "
                f"{self.config.num_updates}, seed {seed}, cell {cell}; lower "
                f"{self.config.algorithm}.learning_rate (the last valid checkpoint is kept)"
            )

    def by_seed(self, metrics: Metrics) -> dict[str, float]:
        """Return the means over the cells of each seed, named ``seedN/...``."""
        scalars = {}
        for name, values in metrics.items():
            means = np.reshape(values, (len(self.seeds), -1)).mean(axis=1)
            for seed, mean in zip(self.seeds, means.tolist(), strict=True):
                scalars[f"seed{seed}/{name}"] = mean
        return scalars

    def note(self, metrics: Metrics, state: RunState) -> str:
        """Return the latest errors as text for a progress bar."""
        decimals = force_decimals(float(np.abs(self.references).max()))

        def shown(x: float, y: float) -> str:
            return f"{x:.{decimals}f}/{y:.{decimals}f} N"

        latest = (float(np.mean(metrics[f"error_{axis}_n"])) for axis in AXES)
        note = f"error {shown(*latest)}"
        best = np.mean(state.best_evaluation.error, axis=(0, 1)).tolist()
        return f"{note}, best deterministic {shown(*best)}" if np.isfinite(best).all() else note

    def result(self, state: RunState) -> BestPolicies:
        """Return the best policies and their evaluation, by seed and cell, as NumPy arrays."""
        shape = (len(self.seeds), len(self.config.cells))
        best: BestPolicies = jax.tree.map(
            lambda x: np.asarray(x).reshape(*shape, *x.shape[1:]),
            (state.best, state.best_evaluation),
        )
        return best


def summary(evaluation: PolicyEvaluation) -> Metrics:
    """Return the mean error of each agent over its references, and for ensembles the mean fraction
    of actions outside the training data."""
    error = np.asarray(evaluation.error)
    outside = evaluation.out_of_distribution_fraction
    scores: Metrics = {}
    for index, axis in enumerate(AXES):
        scores[f"score_{axis}_n"] = error[..., index].mean(-1)
    if outside is not None:
        scores["score_out_of_distribution"] = np.asarray(outside).mean(axis=-1)
    return scores


def keep_best(state: RunState, evaluation: PolicyEvaluation) -> RunState:
    """Replace the best policy of each agent by the current one if its mean error is lower; the
    results are NumPy arrays."""
    new = np.asarray(evaluation.error).mean(axis=(1, 2))
    old = np.asarray(state.best_evaluation.error).mean(axis=(1, 2))
    # False for NaN. Axes of length 1 are appended to broadcast along the first axis of each leaf.
    better = new < old
    best, best_evaluation = jax.tree.map(
        lambda a, b: np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b),
        (state.agents.policy, evaluation),
        (state.best, state.best_evaluation),
    )
    return state._replace(best=best, best_evaluation=best_evaluation)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def without_keys(tree: AgentTree) -> AgentTree:
    """Convert the random keys of a tree to integers, because files cannot contain keys."""
    return cast(
        AgentTree, jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)
    )


def with_keys(tree: AgentTree, like: AgentTree) -> AgentTree:
    """Convert integers back to random keys at the leaves where `like` has keys."""
    return cast(
        AgentTree,
        jax.tree.map(lambda x, y: jax.random.wrap_key_data(x) if _is_key(y) else x, tree, like),
    )
