"""LSTM-PPO (Schulman et al. 2017) on one lane: collect, advantages, epochs of clipped updates. Pure; `vmap` adds lanes.

A lane is one policy with its own key and its own box of references. Its networks read and say numbers in units of
their own running mean and deviation, and the policy that counts is an average over the last updates.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from softfin.core.action_clock import ACTION_TICKS
from softfin.core.configuration import Configuration
from softfin.learning.advantage import advantages
from softfin.learning.learner import Metrics, clipped_adam
from softfin.learning.lstm import Memory
from softfin.learning.policy import ActorCritic, Critic, Policy, PolicyConfig
from softfin.learning.rollout import Batch, Rollout, begin, collect
from softfin.task.references import References
from softfin.task.task import ForceTracking

RECENT_UPDATES = 4
"""Values are scaled by those of about as many rollouts: they rise as the policy learns."""


class PPOConfig(Configuration):
    """The learner, tuned for the paper's budgets: a few tens of updates, from each of which much is learnt."""

    environments: PositiveInt = 8
    """Fins that each policy beats side by side."""
    rollout_actions: int = Field(default=30, ge=3, multiple_of=3)
    """Actions of each fin between updates, whole cycles of three; gradients reach back as far."""
    epochs: PositiveInt = 20
    """Passes over each rollout."""
    minibatches: PositiveInt = 4
    """Updates a pass; each takes whole sequences of environments/minibatches fins."""
    learning_rate: PositiveFloat = 3e-3
    """Of Adam, at the start."""
    final_learning_rate: float = Field(default=0.1, ge=0, le=1)
    """At the end, as a part of that at the start; in between it falls linearly."""
    discount: float = Field(default=0.8, gt=0, lt=1)
    """Gamma an action; 0.8 looks ahead 5 actions, and the window of the reward holds the last 6."""
    trace: float = Field(default=0.8, ge=0, le=1)
    """Lambda of the advantages."""
    clip: PositiveFloat = 0.2
    """Of the ratio of densities."""
    entropy: NonNegativeFloat = 0.0
    """Weight of the entropy [1/nat], at the start."""
    final_entropy: float = Field(default=0.0, ge=0, le=1)
    """At the end, as a part of that at the start; in between it falls linearly."""
    averaging: NonNegativeFloat = 2.0
    """About so many updates is the policy averaged over that is scored and kept; 0 is the newest."""
    normalise: bool = True
    """Whether observations and values are learnt in units of their own running mean and deviation."""
    value_weight: PositiveFloat = 0.5
    """Weight of the critic's loss."""
    gradient_norm: PositiveFloat = 0.5
    """Longer gradients are scaled down to this."""

    @model_validator(mode="after")
    def _divides(self) -> "PPOConfig":
        if self.environments % self.minibatches:
            raise ValueError(
                f"environments = {self.environments} do not make {self.minibatches} equal minibatches; "
                "give a multiple of minibatches"
            )
        return self

    @property
    def steps_per_update(self) -> int:
        """Actions over all environments."""
        return self.environments * self.rollout_actions

    @property
    def gradients_per_update(self) -> int:
        """Steps of the optimiser."""
        return self.epochs * self.minibatches

    def learning_rates(self, updates: int) -> optax.Schedule:
        """Of a run, by the optimiser's steps."""
        end = self.learning_rate * self.final_learning_rate
        return optax.linear_schedule(self.learning_rate, end, updates * self.gradients_per_update)

    def entropies(self, updates: int) -> optax.Schedule:
        """Weights of a run, by its updates."""
        return optax.linear_schedule(self.entropy, self.entropy * self.final_entropy, updates)


class Lane(NamedTuple):
    """Everything that one policy's training carries from update to update."""

    networks: ActorCritic
    policy: Policy
    """The actor, averaged over the last updates: it is scored and kept, and never acts in training."""
    optimiser: Any
    batch: Batch
    key: PRNGKeyArray
    updates: Int[Array, ""]
    """Done so far."""


class Lesson(NamedTuple):
    """A rollout and what is to be learnt from it."""

    rollout: Rollout
    advantage: Float[Array, "time environments"]
    """Mean 0, standard deviation 1."""
    target: Float[Array, "time environments"]
    """Of the critic."""


@dataclass(frozen=True)
class PPO:
    """The learner for a task, over a number of updates."""

    task: ForceTracking
    config: PPOConfig
    policy: PolicyConfig
    updates: int

    def init(self, key: PRNGKeyArray, references: References) -> Lane:
        """New networks, fins at rest."""
        network_key, batch_key, key = jax.random.split(key, 3)
        state = jax.eval_shape(self.task.reset, batch_key, references)
        seen = jax.eval_shape(self.task.inspect, state)
        networks = ActorCritic.create(network_key, self.policy, self.task.config.observations, len(seen))
        batch = begin(self.task, networks.policy, references, batch_key, self.config.environments)
        return Lane(networks, networks.policy, self._optimiser().init(networks), batch, key, jnp.int32(0))

    def update(self, lane: Lane) -> tuple[Lane, Metrics]:
        """Collect a rollout and learn from it."""
        collect_key, learn_key, key = jax.random.split(lane.key, 3)
        cycles = self.config.rollout_actions // len(ACTION_TICKS)
        batch, rollout = collect(self.task, lane.networks.policy, lane.batch, collect_key, cycles)
        lesson, metrics = self.lesson(lane.networks.critic, rollout)
        if self.config.normalise:
            lane = lane._replace(networks=self._values_scaled(lane.networks, lesson))
        networks, averaged, optimiser, learning = self._learn(lane, lesson, learn_key)
        if self.config.normalise:  # behind the learning, so that densities there are as they were lived with
            policy = networks.policy.having_seen(rollout.observation)
            networks = ActorCritic(policy, networks.critic)
            averaged = averaged.normalised(policy.normalisation)
        return Lane(networks, averaged, optimiser, batch, key, lane.updates + 1), metrics | learning

    def loss(
        self, networks: ActorCritic, lesson: Lesson, start: Memory, entropy: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Metrics]:
        """Clipped surrogate objective, squared error of the critic, weighed entropy; whole sequences from `start`."""
        config, rollout = self.config, lesson.rollout
        replay = jax.vmap(networks.policy.sequence, in_axes=(0, 1, 1), out_axes=1)
        mean = replay(start, rollout.observation, rollout.fresh)
        log_ratio = networks.policy.log_density(mean, rollout.raw) - rollout.log_density
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        objective = jnp.minimum(ratio * lesson.advantage, clipped * lesson.advantage).mean()
        value_loss = networks.critic.loss(rollout.seen, lesson.target)
        loss = -objective + config.value_weight * value_loss - entropy * networks.policy.entropy()
        beyond_clip = jnp.mean(jnp.abs(ratio - 1) > config.clip)
        kl = jnp.mean(ratio - 1 - log_ratio)
        return loss, {"loss": loss, "value_loss": value_loss, "kl": kl, "clipped": beyond_clip}

    def lesson(self, critic: Critic, rollout: Rollout) -> tuple[Lesson, Metrics]:
        """With rewards in units of 1 - discount, values are means of the reward ahead [N], whatever the discount."""
        discount = self.config.discount
        value, value_after = critic(rollout.seen), critic(rollout.seen_after)
        reward = (1 - discount) * rollout.reward
        advantage = advantages(reward, value, value_after, rollout.cut, discount, self.config.trace)
        normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        target = advantage + value
        return Lesson(rollout, normal, target), {
            "reward": rollout.reward.mean(),
            "error_x_n": rollout.error[..., 0].mean(),
            "error_y_n": rollout.error[..., 1].mean(),
            "explained": 1 - jnp.var(advantage) / (jnp.var(target) + 1e-8),
        }

    def _values_scaled(self, networks: ActorCritic, lesson: Lesson) -> ActorCritic:
        recent = RECENT_UPDATES * self.config.steps_per_update
        return ActorCritic(networks.policy, networks.critic.having_seen(lesson.rollout.seen, lesson.target, recent))

    def _learn(self, lane: Lane, lesson: Lesson, key: PRNGKeyArray) -> tuple[ActorCritic, Policy, Any, Metrics]:
        config, optimiser = self.config, self._optimiser()
        entropy = jnp.asarray(config.entropies(self.updates)(lane.updates))
        share = 1 / max(1.0, config.averaging * config.gradients_per_update)

        def minibatch(carry: tuple[ActorCritic, Policy, Any], chosen: Int[Array, "some"]) -> tuple[Any, Metrics]:
            networks, averaged, state = carry
            part = jax.tree.map(lambda x: x[:, chosen], lesson)
            start = jax.tree.map(lambda x: x[chosen], lane.batch.memories)
            gradient, metrics = jax.grad(self.loss, has_aux=True)(networks, part, start, entropy)
            change, state = optimiser.update(gradient, state, networks)
            metrics["gradient_norm"] = optax.tree.norm(gradient)
            networks = optax.apply_updates(networks, change)
            return (networks, optax.incremental_update(networks.policy, averaged, share), state), metrics

        fins = jnp.tile(jnp.arange(config.environments), (config.epochs, 1))
        order = jax.random.permutation(key, fins, axis=1, independent=True)
        batches = order.reshape(config.gradients_per_update, -1)
        start = (lane.networks, lane.policy, lane.optimiser)
        (networks, averaged, state), metrics = jax.lax.scan(minibatch, start, batches)
        metrics["deviation"] = jnp.exp(networks.policy.log_deviation)
        return networks, averaged, state, jax.tree.map(jnp.mean, metrics)

    def _optimiser(self) -> optax.GradientTransformation:
        rate = self.config.learning_rates(self.updates)
        return clipped_adam(rate, self.config.gradient_norm)
