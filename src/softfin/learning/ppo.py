"""LSTM-PPO (Schulman et al. 2017): collect a rollout, compute advantages, run epochs of clipped
updates.

Inputs and values of the networks are normalized by their running mean and standard deviation. The
evaluated policy is an average over the most recent updates. All functions are pure and train a
single agent; `vmap` adds agents.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from softfin.control.policy import PolicyMemory
from softfin.core.configuration import Configuration
from softfin.learning.policy import ActorCritic, Critic, Policy, PolicyConfig
from softfin.learning.rollout import (
    AgentState,
    Metrics,
    Rollout,
    collect_rollout,
    start_episodes,
)
from softfin.task.references import References
from softfin.task.task import ForceTracking

RECENT_UPDATES = 4
"""Number of rollouts over which values are normalized; older values are forgotten because values
increase as the policy learns."""

PerStep = Float[Array, "time environments"]


class PPOConfig(Configuration):
    """Configuration of LSTM-PPO."""

    num_envs: PositiveInt = 64
    """Number of parallel environments per policy."""
    num_steps: PositiveInt = 15
    """Number of actions per environment and update, a multiple of the clock cycle; gradients are
    propagated through all of these actions."""
    num_epochs: PositiveInt = 4
    """Number of passes over each rollout."""
    num_minibatches: PositiveInt = 8
    """Number of minibatches per epoch. Each minibatch contains complete sequences from num_envs /
    num_minibatches environments."""
    learning_rate: PositiveFloat = 3e-3
    """Initial learning rate of Adam."""
    final_learning_rate: float = Field(default=0.03, ge=0, le=1)
    """Final learning rate as a fraction of the initial learning rate (linear decay)."""
    discount: float = Field(default=0.8, gt=0, lt=1)
    """Discount factor gamma per action. With 0.8, the horizon is about 5 actions; the reward window
    has 6."""
    gae_lambda: float = Field(default=0.8, ge=0, le=1)
    """Lambda of generalized advantage estimation."""
    clip_ratio: PositiveFloat = 0.2
    """Clipping range epsilon of the probability ratio."""
    entropy_coef: NonNegativeFloat = 0.0
    """Initial weight of the entropy [1/nat]; it decays linearly to 0."""
    averaging: NonNegativeFloat = 2.0
    """Approximate number of updates over which the evaluated policy is averaged; 0 to evaluate the
    latest policy."""
    value_coef: PositiveFloat = 0.5
    """Weight of the critic loss."""
    max_grad_norm: PositiveFloat = 0.5
    """Maximum norm of the gradient; larger gradients are scaled down."""

    @model_validator(mode="after")
    def _divides(self) -> "PPOConfig":
        if self.num_envs % self.num_minibatches:
            raise ValueError(
                f"num_envs = {self.num_envs} must be a multiple of num_minibatches = "
                f"{self.num_minibatches}"
            )
        return self

    @property
    def steps_per_update(self) -> int:
        """Number of actions per update over all environments."""
        return self.num_envs * self.num_steps

    @property
    def gradients_per_update(self) -> int:
        """Number of optimizer steps per update."""
        return self.num_epochs * self.num_minibatches

    def learning_rates(self, updates: int) -> optax.Schedule:
        """Return the learning rate schedule over the optimizer steps of a run."""
        end = self.learning_rate * self.final_learning_rate
        return optax.linear_schedule(self.learning_rate, end, updates * self.gradients_per_update)

    def entropy_coefs(self, updates: int) -> optax.Schedule:
        """Return the schedule of the entropy weight over the updates of a run."""
        return optax.linear_schedule(self.entropy_coef, 0.0, updates)


class Batch(NamedTuple):
    """A rollout with advantages and critic targets."""

    rollout: Rollout
    advantage: PerStep
    """Advantages, normalized to mean 0 and standard deviation 1."""
    target: PerStep
    """Targets of the critic."""


Learners: TypeAlias = tuple[ActorCritic, Policy, PyTree]
"""The trained networks, the averaged policy, and the state of the optimizer."""
Learned: TypeAlias = tuple[Learners, Metrics]


@dataclass(frozen=True)
class PPO:
    """LSTM-PPO on a task, for a given number of updates."""

    task: ForceTracking
    config: PPOConfig
    policy: PolicyConfig
    num_updates: int

    def init(self, key: PRNGKeyArray, references: References) -> AgentState:
        """Return the state of an agent with new networks and fins at rest."""
        network_key, environment_key, key = jax.random.split(key, 3)
        # Only the size of the privileged observation is needed, so the plant is not simulated.
        state = jax.eval_shape(self.task.reset, environment_key, references)
        privileged = jax.eval_shape(self.task.privileged_observation, state)
        actor_key, critic_key = jax.random.split(network_key)
        policy = Policy.create(actor_key, self.policy, self.task.config.observations)
        networks = ActorCritic(
            policy, Critic.create(critic_key, len(privileged), self.policy.critic_width)
        )
        env_state = start_episodes(
            self.task, policy, references, environment_key, self.config.num_envs
        )
        return AgentState(
            networks, policy, self._optimiser().init(networks), env_state, key, jnp.int32(0)
        )

    def update(self, agent: AgentState) -> tuple[AgentState, Metrics]:
        """Collect a rollout and train on it."""
        networks = agent.networks
        collect_key, learn_key, key = jax.random.split(agent.key, 3)
        cycles = self.config.num_steps // len(self.task.config.clock.ticks)
        env_state, rollout = collect_rollout(
            self.task, networks.policy, agent.env_state, collect_key, cycles
        )
        batch, metrics = self.batch(networks.critic, rollout)
        # Updated before training so that the critic targets are normalized from the first update
        # on.
        recent = RECENT_UPDATES * self.config.steps_per_update
        critic = networks.critic.update_statistics(
            rollout.privileged_observation, batch.target, recent
        )
        networks = ActorCritic(networks.policy, critic)
        learners, learning = self._learn(agent, networks, batch, learn_key)
        networks, averaged, optimiser = learners
        # Updated after training: otherwise, the normalized observations would change and the
        # probability ratios would not start at 1.
        policy = networks.policy.update_statistics(rollout.observation)
        networks = ActorCritic(policy, networks.critic)
        averaged = averaged.with_normalisation(policy.normalisation)
        agent = AgentState(networks, averaged, optimiser, env_state, key, agent.num_updates + 1)
        return agent, metrics | learning

    def batch(self, critic: Critic, rollout: Rollout) -> tuple[Batch, Metrics]:
        """Compute the advantages and the critic targets for a rollout.

        Rewards are multiplied by 1 - discount so that values are weighted means of future rewards
        [N] for any discount.
        """
        discount = self.config.discount
        value = critic(rollout.privileged_observation)
        next_value = critic(rollout.next_privileged_observation)
        reward = (1 - discount) * rollout.reward
        advantage = advantages(
            reward, value, next_value, rollout.truncated, discount, self.config.gae_lambda
        )
        normalised = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        target = advantage + value
        return Batch(rollout, normalised, target), {
            "reward": rollout.reward.mean(),
            "error_x_n": jnp.abs(rollout.force_error[..., 0]).mean(),
            "error_y_n": jnp.abs(rollout.force_error[..., 1]).mean(),
            "explained": 1 - jnp.var(advantage) / (jnp.var(target) + 1e-8),
        }

    def loss(
        self,
        networks: ActorCritic,
        batch: Batch,
        start: PolicyMemory,
        entropy_coef: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Metrics]:
        """Return the loss and its metrics for complete sequences that start with the memories
        `start`.

        The loss is the negative clipped objective plus the weighted critic loss, minus the weighted
        entropy.
        """
        config = self.config
        rollout = batch.rollout
        # Time is the first axis of a rollout, and the memories have none.
        replay = jax.vmap(networks.policy.sequence, in_axes=(0, 1, 1), out_axes=1)
        mean = replay(start, rollout.observation, rollout.is_first)
        log_ratio = networks.policy.log_prob(mean, rollout.pre_tanh_action) - rollout.log_prob
        # The objective is min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A), with the ratio of
        # probabilities and the advantage A.
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - config.clip_ratio, 1 + config.clip_ratio)
        objective = jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
        value_loss = networks.critic.loss(rollout.privileged_observation, batch.target)
        loss = (
            -objective
            + config.value_coef * value_loss
            - entropy_coef * networks.policy.action_entropy()
        )
        beyond_clip = jnp.mean(jnp.abs(ratio - 1) > config.clip_ratio)
        # E[ratio - 1 - log ratio] is a non-negative estimate of the KL divergence.
        kl = jnp.mean(ratio - 1 - log_ratio)
        return loss, {"loss": loss, "value_loss": value_loss, "kl": kl, "clipped": beyond_clip}

    def _learn(
        self, agent: AgentState, networks: ActorCritic, batch: Batch, key: PRNGKeyArray
    ) -> Learned:
        """Run all epochs of minibatches on a rollout."""
        config = self.config
        optimiser = self._optimiser()
        entropy_coef = jnp.asarray(config.entropy_coefs(self.num_updates)(agent.num_updates))
        # Weight of the newest policy in the exponential moving average, per optimizer step.
        newest = 1 / max(1.0, config.averaging * config.gradients_per_update)
        memories = agent.env_state.memories

        def minibatch(carry: Learners, chosen: Int[Array, "some"]) -> Learned:
            networks, averaged, state = carry
            part = jax.tree.map(lambda x: x[:, chosen], batch)
            start = jax.tree.map(lambda x: x[chosen], memories)
            gradient, metrics = jax.grad(self.loss, has_aux=True)(
                networks, part, start, entropy_coef
            )
            change, state = optimiser.update(gradient, state, networks)
            metrics["gradient_norm"] = optax.tree.norm(gradient)
            networks = optax.apply_updates(networks, change)
            averaged = optax.incremental_update(networks.policy, averaged, newest)
            return (networks, averaged, state), metrics

        def epoch(carry: Learners, key: PRNGKeyArray) -> Learned:
            order = jax.random.permutation(key, config.num_envs)
            return jax.lax.scan(minibatch, carry, order.reshape(config.num_minibatches, -1))

        start = (networks, agent.policy, agent.optimiser)
        learners, metrics = jax.lax.scan(epoch, start, jax.random.split(key, config.num_epochs))
        metrics["std"] = jnp.exp(learners[0].policy.log_std)
        return learners, jax.tree.map(jnp.mean, metrics)

    def _optimiser(self) -> optax.GradientTransformation:
        rate = self.config.learning_rates(self.num_updates)
        limit = optax.clip_by_global_norm(self.config.max_grad_norm)
        # All weights as one vector compile faster than one operation per array.
        return optax.flatten(optax.chain(limit, optax.adam(rate, eps=1e-5)))


def advantages(
    reward: PerStep,
    value: PerStep,
    next_value: PerStep,
    truncated: Bool[Array, "time environments"],
    discount: float,
    gae_lambda: float,
) -> PerStep:
    """Return the generalized advantage estimates (Schulman et al. 2016).

    A_t = d_t + discount lambda A_{t+1},  d_t = r_t + discount V'_t - V_t

    V' is the value of the state after the action and before any reset. A truncated episode could
    have continued, so it is bootstrapped with V', but the recursion stops there.
    """
    errors = reward + discount * next_value - value

    def back(advantage: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        error, factor = now
        advantage = error + factor * advantage
        return advantage, advantage

    factors = jnp.where(truncated, 0.0, discount * gae_lambda)
    return jax.lax.scan(back, jnp.zeros_like(errors[0]), (errors, factors), reverse=True)[1]
