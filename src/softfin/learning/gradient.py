"""Gradient training: the force error of whole rollouts is differentiated through the plant into the policy.

The policy begins as a copy of a table of gaits (behaviour cloning), so that gradients only have to correct its errors.
A gait's action depends on the reference and the phase alone, so the expert action is defined in every state.

Then truncated backpropagation through time, the short horizon of Xu et al. 2022 (SHAC) without its critic: an action
acts on the fin for two or three seconds, and the window of the reward holds two, so a rollout of six seconds covers
nearly all effects of an action. Pure; one agent, `vmap` adds agents.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.control.policy import PolicyMemory
from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.plant import Ticks
from softfin.gaits.force_map import MapConfig
from softfin.gaits.gait import GaitTable
from softfin.learning.layers import cleared
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import AgentState, EnvState, Metrics, clipped_adam, reset_truncated, start_episodes
from softfin.task.references import References
from softfin.task.task import ForceTracking, RewardTerms, TaskState


class CloningConfig(Configuration):
    """Settings of behaviour cloning."""

    num_envs: PositiveInt = 192
    """Fins that the gaits move, each with two references, one after the other."""
    num_steps: int = Field(default=36, ge=12, multiple_of=6)
    """Actions of each fin; the reference changes in the middle."""
    num_updates: PositiveInt = 1200
    """Steps of Adam, each over `batch_size` fins."""
    batch_size: PositiveInt = 48
    """Fins of one step."""
    learning_rate: PositiveFloat = 4e-3
    """Learning rate at the start; it falls as a cosine to nothing."""


class Demonstrations(NamedTuple):
    """Observations and the gaits' actions, ``(time, env_state, ...)``."""

    observation: Float[Array, "*batch observations"]
    action: Float[Array, "*batch 2"]


def clone_gaits(
    task: ForceTracking, policy: Policy, table: GaitTable, references: References, key: PRNGKeyArray,
    config: CloningConfig,
) -> Policy:  # fmt: skip
    """The policy, trained to act as the table does for references from the box."""
    record_key, draw_key = jax.random.split(key)
    demonstrations = record_demonstrations(task, table, references, record_key, config)
    schedule = optax.cosine_decay_schedule(config.learning_rate, config.num_updates)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    is_first = jnp.zeros(config.num_steps, bool)

    def loss(policy: Policy, chosen: Demonstrations) -> Float[Array, ""]:
        start: PolicyMemory = jax.tree.map(lambda x: jnp.tile(x, (chosen.action.shape[1], 1)), policy.init())
        mean = jax.vmap(policy.sequence, in_axes=(0, 1, None), out_axes=1)(start, chosen.observation, is_first)
        return jnp.mean((jnp.tanh(mean) - chosen.action) ** 2)

    def step(carry: tuple[Policy, optax.OptState], key: PRNGKeyArray) -> tuple[tuple[Policy, optax.OptState], None]:
        policy, state = carry
        fins = jax.random.choice(key, config.num_envs, (min(config.batch_size, config.num_envs),), replace=False)
        slope = jax.grad(loss)(policy, jax.tree.map(lambda x: x[:, fins], demonstrations))
        change, state = optimiser.update(slope, state)
        return (optax.apply_updates(policy, change), state), None

    keys = jax.random.split(draw_key, config.num_updates)
    (policy, _), _ = jax.lax.scan(step, (policy, optimiser.init(policy)), keys)
    return policy


def record_demonstrations(
    task: ForceTracking, table: GaitTable, references: References, key: PRNGKeyArray, config: CloningConfig
) -> Demonstrations:
    """Let the table act from rest."""
    reset_key, change_key = jax.random.split(key)
    states = jax.vmap(task.reset, (0, None))(jax.random.split(reset_key, config.num_envs), references)
    later = jax.vmap(references.draw)(jax.random.split(change_key, config.num_envs))

    def act(
        state: TaskState, later: Float[Array, "2"], is_late: Bool[Array, ""], ticks: Ticks
    ) -> tuple[TaskState, Demonstrations]:
        state = state._replace(reference=jnp.where(is_late, later, state.reference))
        action = table.gait(state.reference)[state.age % CYCLE_ACTIONS]
        return task.step(state, action, ticks)[0], Demonstrations(task.observe(state), action)

    each = jax.vmap(act, (0, 0, None, None))
    is_late = jnp.arange(config.num_steps) >= config.num_steps // 2
    times = (is_late, jnp.asarray(ticks_of(config.num_steps)))
    return jax.lax.scan(lambda states, now: each(states, later, *now), states, times)[1]


class SharedPretraining(Configuration):
    """Training of one policy for all cells of a grid, from which theirs begin."""

    num_updates: PositiveInt = 120
    """Updates of the shared policy."""
    num_envs: PositiveInt = 32
    """Fins that it moves side by side."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate of Adam, at its greatest."""
    lattice: PositiveInt = 3
    """The policy is evaluated at lattice x lattice references over all cells."""


class GradientConfig(Configuration):
    """Settings of gradient training."""

    num_envs: PositiveInt = 32
    """Fins that each policy moves side by side."""
    num_steps: int = Field(default=18, ge=3, multiple_of=3)
    """Actions between updates, whole cycles of three; gradients reach back as far."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate of Adam, at its greatest."""
    final_learning_rate: float = Field(default=0.01, ge=0, le=1)
    """Learning rate at the end, as a part of the greatest; it falls as a cosine."""
    max_grad_norm: PositiveFloat = 1.0
    """Norm to which longer gradients are scaled down."""
    rounding_n: PositiveFloat = 0.05
    """Force errors below this are weighed as their squares [N]: near 0 the sign of an error is mostly noise."""
    warm_start: bool = True
    """Whether the policy begins as a copy of a table of gaits."""
    map: MapConfig = MapConfig()
    """How the table is found; its box is the bounding box of all cells."""
    cloning: CloningConfig = CloningConfig()
    """How the table is copied."""
    shared_pretraining: SharedPretraining | None = None
    """Training of one policy for all cells of a grid, from which theirs begin; none: they begin from the gaits."""

    @property
    def steps_per_update(self) -> int:
        """Actions of an update over all environments."""
        return self.num_envs * self.num_steps


@dataclass(frozen=True)
class Gradient:
    """The learner for a task, over a number of updates."""

    task: ForceTracking
    config: GradientConfig
    policy: PolicyConfig
    num_updates: int
    table: GaitTable | None = None
    """Gaits that the policy begins as."""

    def init(self, key: PRNGKeyArray, references: References) -> AgentState:
        """A new policy, fins at rest."""
        network_key, environment_key, clone_key, key = jax.random.split(key, 4)
        policy = Policy.create(network_key, self.policy, self.task.config.observations)
        if self.table is not None:
            policy = clone_gaits(self.task, policy, self.table, references, clone_key, self.config.cloning)
        env_state = start_episodes(self.task, policy, references, environment_key, self.config.num_envs)
        return AgentState(None, policy, self._optimiser().init(policy), env_state, key, jnp.int32(0))

    def update(self, agent: AgentState) -> tuple[AgentState, Metrics]:
        """A rollout without noise, and one step down the gradient of its loss."""
        gradient, (env_state, metrics) = jax.grad(self.loss, has_aux=True)(agent.policy, agent.env_state)
        change, optimiser = self._optimiser().update(gradient, agent.optimiser, agent.policy)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        return agent._replace(
            policy=optax.apply_updates(agent.policy, change),
            optimiser=optimiser,
            env_state=reset_truncated(self.task, env_state),
            num_updates=agent.num_updates + 1,
        ), metrics

    def loss(self, policy: Policy, env_state: EnvState) -> tuple[Float[Array, ""], tuple[EnvState, Metrics]]:
        """The negative reward, a mean over the rollout, with force errors rounded near 0 [N]."""
        task, reward, rounding = self.task, self.task.config.reward, self.config.rounding_n

        def act(now: EnvState, ticks: Ticks) -> tuple[EnvState, tuple[Array, RewardTerms]]:
            memories = jax.vmap(cleared)(now.memories, now.is_first)
            memories, action = jax.vmap(policy.act)(memories, jax.vmap(task.observe)(now.states))
            states, outcome = jax.vmap(partial(task.step, ticks=ticks))(now.states, action)
            return EnvState(states, memories, jnp.zeros_like(now.is_first)), (outcome.reward, outcome.terms)

        ticks = jnp.asarray(ticks_of(self.config.num_steps))
        env_state, (rewards, terms) = jax.lax.scan(act, env_state, ticks)
        rounded = jnp.sqrt(terms.error**2 + rounding**2) - rounding
        loss = -reward.value(terms._replace(error=rounded)).mean()
        x, y = terms.error.mean(axis=(0, 1))
        return loss, (env_state, {"loss": loss, "reward": rewards.mean(), "error_x_n": x, "error_y_n": y})

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config
        rate = optax.cosine_decay_schedule(config.learning_rate, self.num_updates, config.final_learning_rate)
        return clipped_adam(rate, config.max_grad_norm)
