"""The state of an agent and its environments, rollouts with exploration noise, and evaluation
episodes without noise.

All environments have the same phase on the 33/33/34 clock. A rollout is a scan over cycles of three
actions, and each action is one vmapped call of the plant.
"""

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from softfin.control.policy import PolicyMemory
from softfin.core.plant import EnsemblePlant, Ticks, drop_padding
from softfin.core.quantities import AnyArray
from softfin.core.window import moving_average, moving_error
from softfin.learning.layers import cleared
from softfin.learning.policy import ActorCritic, BatchScalars, Policy, PrivilegedBatch
from softfin.task.references import References
from softfin.task.task import ForceTracking, TaskState


class EnvState(NamedTuple):
    """State of the environments of an agent between two actions; all leaves have a leading axis of
    environments."""

    states: TaskState
    memories: PolicyMemory
    """Memory of the policy after all observations before the current one."""
    is_first: Bool[Array, "environments"]
    """Whether the environment was just reset; the memory is then from the previous episode and must
    be cleared."""


class AgentState(NamedTuple):
    """Training state of one policy between updates."""

    networks: ActorCritic
    """Networks that act and learn."""
    policy: Policy
    """Policy that is evaluated and saved: an average over the most recent updates."""
    optimiser: PyTree
    env_state: EnvState
    key: PRNGKeyArray
    num_updates: Int[Array, ""]
    """Number of updates so far."""


Metrics: TypeAlias = dict[str, Float[AnyArray, "*agents"]]
"""Scalars per update: ``loss``, ``error_x_n``, ``error_y_n`` [N], ``gradient_norm``, and metrics of
the algorithm."""


class Rollout(NamedTuple):
    """Transitions of all environments, ``(time, environments, ...)``."""

    observation: Float[Array, "*batch observations"]
    pre_tanh_action: Float[Array, "*batch actions"]
    log_prob: BatchScalars
    """Log-density of the action before the tanh."""
    reward: BatchScalars
    force_error: Float[Array, "*batch 2"]
    """Force error F_e over the window [N]."""
    privileged_observation: PrivilegedBatch
    """Input of the critic before the action."""
    next_privileged_observation: PrivilegedBatch
    """Input of the critic after the action, before any reset."""
    is_first: Bool[Array, "*batch"]
    """Whether the environment was reset just before the action."""
    truncated: Bool[Array, "*batch"]
    """Whether the episode was truncated just after the action."""


Acted: TypeAlias = tuple[EnvState, Rollout]
"""State of the environments after some actions, and what was collected in them."""


def start_episodes(
    task: ForceTracking, policy: Policy, references: References, key: PRNGKeyArray, count: int
) -> EnvState:
    """Return environments with fins at rest.

    The first episodes are shortened by different numbers of cycles so that later resets do not all
    happen at the same time.
    """
    states = jax.vmap(task.reset, (0, None))(jax.random.split(key, count), references)
    cycle = len(task.config.clock.ticks)
    cycles = task.config.episode_actions // cycle
    # Environment k starts k / count into its episode, rounded down to complete cycles.
    age = jnp.arange(count) * cycles // count * cycle
    memories = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), policy.init())
    return EnvState(states._replace(age=age.astype(jnp.int32)), memories, jnp.ones(count, bool))


def collect_rollout(
    task: ForceTracking, policy: Policy, env_state: EnvState, key: PRNGKeyArray, cycles: int
) -> Acted:
    """Take the actions of `cycles` cycles of the clock in each environment; environments are reset
    at the end of their episodes."""

    clock = task.config.clock

    def cycle(env_state: EnvState, noise: Float[Array, "cycle environments actions"]) -> Acted:
        held = (noise, jnp.asarray(clock.ticks))
        env_state, steps = jax.lax.scan(
            lambda now, action: _act(task, policy, now, *action), env_state, held
        )
        # Episodes end only at the end of a cycle so that all environments keep the same phase.
        env_state = reset_truncated(task, env_state)
        return env_state, steps._replace(truncated=steps.truncated.at[-1].set(env_state.is_first))

    noise = jax.random.normal(
        key, (cycles, len(clock.ticks), len(env_state.is_first), len(policy.log_std))
    )
    env_state, rollout = jax.lax.scan(cycle, env_state, noise)
    return env_state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)


def _act(
    task: ForceTracking,
    policy: Policy,
    env_state: EnvState,
    noise: Float[Array, "environments actions"],
    ticks: Ticks,
) -> Acted:
    memories = jax.vmap(cleared)(env_state.memories, env_state.is_first)
    observation = jax.vmap(task.observe)(env_state.states)
    memories, mean = jax.vmap(policy.step)(memories, observation)
    # a = tanh(u) with u ~ N(mean, std). `mean` and log_prob(u) are kept for the PPO ratios.
    pre_tanh_action = mean + jnp.exp(policy.log_std) * noise
    states, outcome = jax.vmap(partial(task.step, ticks=ticks))(
        env_state.states, jnp.tanh(pre_tanh_action)
    )
    nowhere = jnp.zeros_like(env_state.is_first)
    step = Rollout(
        observation=observation,
        pre_tanh_action=pre_tanh_action,
        log_prob=policy.log_prob(mean, pre_tanh_action),
        reward=outcome.reward,
        force_error=outcome.force_error,
        privileged_observation=jax.vmap(task.privileged_observation)(env_state.states),
        next_privileged_observation=jax.vmap(task.privileged_observation)(states),
        is_first=env_state.is_first,
        truncated=nowhere,
    )
    return EnvState(states, memories, nowhere), step


def reset_truncated(task: ForceTracking, env_state: EnvState) -> EnvState:
    """Reset the environments whose episodes are over."""
    truncated = jax.vmap(task.truncated)(env_state.states)

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(truncated.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    # All environments are reset and the finished ones selected because a branch cannot depend on
    # traced values.
    again = jax.vmap(task.reset)(env_state.states.key, env_state.states.references)
    return EnvState(jax.tree.map(choose, again, env_state.states), env_state.memories, truncated)


class PolicyEvaluation(NamedTuple):
    """Errors of a policy without exploration noise in one episode per reference, as in Table II of
    the paper."""

    error: Float[AnyArray, "*batch references 2"]
    """Mean of |moving average - reference| over all complete windows [N]."""
    std: Float[AnyArray, "*batch references 2"]
    """Standard deviation of the moving average [N]."""
    out_of_distribution_fraction: Float[AnyArray, "*batch references"] | None = None
    """Fraction of actions outside the training data of an ensemble; None if the plant is not an
    ensemble."""


def evaluate_policy(
    task: ForceTracking, policy: Policy, references: Float[Array, "references 2"], key: PRNGKeyArray
) -> PolicyEvaluation:
    """Run one episode from rest for each constant reference, all in parallel."""
    count = len(references)
    clock = task.config.clock
    states = jax.vmap(task.reset)(
        jax.random.split(key, count), References(references, references, None)
    )
    memories = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), policy.init())
    plant = task.plant if isinstance(task.plant, EnsemblePlant) else None

    def act(
        carry: tuple[PyTree, PyTree], ticks: Ticks
    ) -> tuple[tuple[Any, Any], tuple[Array, Array]]:
        states, memories = carry
        memories, actions = jax.vmap(policy.act)(memories, jax.vmap(task.observe)(states))
        states, outcome = jax.vmap(partial(task.step, ticks=ticks))(states, actions)
        distance = jnp.zeros(count) if plant is None else jax.vmap(plant.distance)(states.plant)
        return (states, memories), (jnp.swapaxes(outcome.forces, 0, 1), distance)

    actions = task.config.episode_actions
    _, (forces, distances) = jax.lax.scan(
        act, (states, memories), jnp.asarray(clock.action_ticks(actions))
    )
    # Each action is padded to the length of the longest action; the series contains only valid
    # ticks.
    series = jnp.swapaxes(drop_padding(forces, actions, clock), 0, 1)
    error = moving_error(series, references[:, None], clock.window_ticks)
    average = moving_average(series, clock.window_ticks)
    # A distance above 1 is out of distribution.
    outside = None if plant is None else (distances > 1).mean(axis=0)
    return PolicyEvaluation(error, average.std(axis=-2), outside)
