"""Gradient training: the force error over a rollout is differentiated with respect to the weights
of the policy, through the plant.

The policy starts from a table of gaits. Its networks add corrections to the actions of the gaits,
so gradients only have to correct errors. The action of a gait depends only on the reference and the
phase, so it is defined in all states.

The algorithm is truncated backpropagation through time, like the short horizon of SHAC (Xu et al.
2022) but without a critic. An action affects the fin for two or three seconds and the window of the
reward is two seconds long, so a rollout of six seconds contains nearly all effects of an action.
All functions are pure and train a single agent; `vmap` adds agents.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.plant import Ticks
from softfin.gaits.force_map import MapConfig
from softfin.gaits.gait import GaitTable
from softfin.learning.layers import cleared
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import (
    AgentState,
    EnvState,
    Metrics,
    clipped_adam,
    reset_truncated,
    start_episodes,
)
from softfin.task.references import References
from softfin.task.task import ForceTracking, RewardTerms


class GradientConfig(Configuration):
    """Configuration of gradient training."""

    num_envs: PositiveInt = 32
    """Number of parallel environments per policy."""
    num_steps: PositiveInt = 18
    """Number of actions per environment and update, whole cycles of the clock; gradients are
    propagated through all of them."""
    learning_rate: PositiveFloat = 1e-3
    """Initial learning rate of Adam."""
    final_learning_rate: float = Field(default=0.01, ge=0, le=1)
    """Final learning rate as a fraction of the initial one (cosine decay)."""
    max_grad_norm: PositiveFloat = 1.0
    """Maximum norm of the gradient; larger gradients are scaled down."""
    rounding_n: PositiveFloat = 0.05
    """Force error below which the loss is quadratic [N]; near 0, the sign of an error is mostly
    noise."""
    warm_start: bool = True
    """Whether the policy starts from a table of gaits."""
    map: MapConfig = MapConfig()
    """Configuration of the map that provides the gaits; its box is the bounding box of all
    cells."""

    @property
    def steps_per_update(self) -> int:
        """Number of actions per update over all environments."""
        return self.num_envs * self.num_steps


@dataclass(frozen=True)
class Gradient:
    """Gradient training on a task for a number of updates."""

    task: ForceTracking
    config: GradientConfig
    policy: PolicyConfig
    num_updates: int
    table: GaitTable | None = None
    """Initial gaits, over references in newtons."""

    def init(self, key: PRNGKeyArray, references: References) -> AgentState:
        """Return the state of an agent with a new policy and fins at rest."""
        network_key, environment_key, key = jax.random.split(key, 3)
        task = self.task.config
        gaits = self.table
        if gaits is not None:
            # Observed references are scaled, so the lattice of the gaits is scaled in the same way.
            gaits = gaits._replace(
                low=gaits.low / task.force_scale_n, high=gaits.high / task.force_scale_n
            )
        policy = Policy.create(network_key, self.policy, task.observations, gaits=gaits)
        env_state = start_episodes(
            self.task, policy, references, environment_key, self.config.num_envs
        )
        return AgentState(
            None, policy, self._optimiser().init(policy), env_state, key, jnp.int32(0)
        )

    def update(self, agent: AgentState) -> tuple[AgentState, Metrics]:
        """Run a rollout without exploration noise and take one gradient step."""
        gradient, (env_state, metrics) = jax.grad(self.loss, has_aux=True)(
            agent.policy, agent.env_state
        )
        change, optimiser = self._optimiser().update(gradient, agent.optimiser, agent.policy)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        return agent._replace(
            policy=optax.apply_updates(agent.policy, change),
            optimiser=optimiser,
            env_state=reset_truncated(self.task, env_state),
            num_updates=agent.num_updates + 1,
        ), metrics

    def loss(
        self, policy: Policy, env_state: EnvState
    ) -> tuple[Float[Array, ""], tuple[EnvState, Metrics]]:
        """Return the negative mean reward of a rollout [N], with force errors smoothed near 0."""
        task = self.task
        reward = self.task.config.reward
        rounding = self.config.rounding_n

        # The gradient flows through the plant, the observations and the memories of all actions.
        def act(now: EnvState, ticks: Ticks) -> tuple[EnvState, tuple[Array, RewardTerms]]:
            memories = jax.vmap(cleared)(now.memories, now.is_first)
            memories, action = jax.vmap(policy.act)(memories, jax.vmap(task.observe)(now.states))
            states, outcome = jax.vmap(partial(task.step, ticks=ticks))(now.states, action)
            return EnvState(states, memories, jnp.zeros_like(now.is_first)), (
                outcome.reward,
                outcome.terms,
            )

        ticks = jnp.asarray(task.config.clock.action_ticks(self.config.num_steps))
        env_state, (rewards, terms) = jax.lax.scan(act, env_state, ticks)
        # sqrt(e^2 + r^2) - r is e^2 / (2 r) near 0 and |e| - r for large errors.
        rounded = jnp.sqrt(terms.error**2 + rounding**2) - rounding
        loss = -reward.value(terms._replace(error=rounded)).mean()
        x, y = terms.error.mean(axis=(0, 1))
        metrics = {"loss": loss, "reward": rewards.mean(), "error_x_n": x, "error_y_n": y}
        return loss, (env_state, metrics)

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config
        rate = optax.cosine_decay_schedule(
            config.learning_rate, self.num_updates, config.final_learning_rate
        )
        return clipped_adam(rate, config.max_grad_norm)
