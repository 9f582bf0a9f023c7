"""LSTM-PPO (Schulman et al. 2017) on one lane: collect, advantages, epochs of clipped updates. Pure; `vmap` adds lanes.

A lane is one policy with its own key and its own box of references.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from softfin.configuration import Configuration
from softfin.tracking.references import References
from softfin.tracking.task import ForceTracking
from softfin.training.advantage import advantages
from softfin.training.policy import ActorCritic, PolicyConfig
from softfin.training.rollout import Batch, Memories, Rollout, begin, collect, values

Metrics: TypeAlias = dict[str, Float[Array, "*lanes"]]


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
    discount: float = Field(default=0.9, gt=0, lt=1)
    """Gamma an action; 0.9 looks ahead 10 actions, and the window of the reward holds 6."""
    trace: float = Field(default=0.95, ge=0, le=1)
    """Lambda of the advantages."""
    clip: PositiveFloat = 0.2
    """Of the ratio of densities."""
    entropy: NonNegativeFloat = 0.0
    """Weight of the entropy [1/nat]."""
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


class Lane(NamedTuple):
    """Everything that one policy's training carries from update to update."""

    networks: ActorCritic
    optimiser: Any
    batch: Batch
    key: PRNGKeyArray


class Lesson(NamedTuple):
    """A rollout and what is to be learnt from it."""

    rollout: Rollout
    advantage: Float[Array, "time environments"]
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
        state = self.task.reset(batch_key, references)
        sizes = len(self.task.observe(state)), len(self.task.inspect(state))
        networks = ActorCritic.create(network_key, self.policy, *sizes)
        batch = begin(self.task, networks, references, batch_key, self.config.environments)
        return Lane(networks, self._optimiser().init(networks), batch, key)

    def update(self, lane: Lane) -> tuple[Lane, Metrics]:
        """Collect a rollout and learn from it."""
        collect_key, learn_key, key = jax.random.split(lane.key, 3)
        batch, rollout = collect(self.task, lane.networks, lane.batch, collect_key, self.config.rollout_actions // 3)
        lesson = self._lesson(rollout, values(self.task, lane.networks, batch))
        networks, optimiser, metrics = self._learn(lane, lesson, learn_key)
        return Lane(networks, optimiser, batch, key), metrics | _summary(lesson, networks)

    def loss(self, networks: ActorCritic, lesson: Lesson, start: Memories) -> tuple[Float[Array, ""], Metrics]:
        """Clipped surrogate objective, squared error of the critic, entropy; over whole sequences from `start`."""
        config, rollout = self.config, lesson.rollout
        over = partial(jax.vmap, in_axes=(0, 1, 1), out_axes=1)
        mean = over(networks.policy.net.sequence)(start.actor, rollout.observation, rollout.fresh)
        value = over(networks.critic.sequence)(start.critic, rollout.seen, rollout.fresh)[..., 0]
        log_ratio = networks.policy.log_density(mean, rollout.raw) - rollout.log_density
        ratio = jnp.exp(log_ratio)
        advantage = (lesson.advantage - lesson.advantage.mean()) / (lesson.advantage.std() + 1e-8)
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        objective = jnp.minimum(ratio * advantage, clipped * advantage).mean()
        value_loss = jnp.mean((value - lesson.target) ** 2)
        loss = -objective + config.value_weight * value_loss - config.entropy * networks.policy.entropy()
        beyond_clip = jnp.mean(jnp.abs(ratio - 1) > config.clip)
        kl = jnp.mean(ratio - 1 - log_ratio)
        return loss, {"loss": loss, "value_loss": value_loss, "kl": kl, "clipped": beyond_clip}

    def _lesson(self, rollout: Rollout, value_after: Float[Array, "environments"]) -> Lesson:
        # With rewards in units of (1 - discount) values are means of the reward ahead [N]: of unit size, any discount.
        reward = (1 - self.config.discount) * rollout.reward
        advantage = advantages(
            reward,
            rollout.value,
            value_after,
            rollout.cut,
            rollout.value_beyond,
            self.config.discount,
            self.config.trace,
        )
        return Lesson(rollout, advantage, advantage + rollout.value)

    def _learn(self, lane: Lane, lesson: Lesson, key: PRNGKeyArray) -> tuple[ActorCritic, Any, Metrics]:
        config, optimiser = self.config, self._optimiser()

        def minibatch(carry: tuple[ActorCritic, Any], chosen: Int[Array, "some"]) -> tuple[Any, Metrics]:
            networks, state = carry
            part = jax.tree.map(lambda x: x[:, chosen], lesson)
            start = jax.tree.map(lambda x: x[chosen], lane.batch.memories)
            gradient, metrics = jax.grad(self.loss, has_aux=True)(networks, part, start)
            change, state = optimiser.update(gradient, state, networks)
            metrics["gradient_norm"] = optax.tree.norm(gradient)
            return (optax.apply_updates(networks, change), state), metrics

        def epoch(carry: Any, key: PRNGKeyArray) -> tuple[Any, Metrics]:
            order = jax.random.permutation(key, config.environments).reshape(config.minibatches, -1)
            return jax.lax.scan(minibatch, carry, order)

        keys = jax.random.split(key, config.epochs)
        (networks, state), metrics = jax.lax.scan(epoch, (lane.networks, lane.optimiser), keys)
        return networks, state, jax.tree.map(jnp.mean, metrics)

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config
        steps = self.updates * config.epochs * config.minibatches
        rate = optax.linear_schedule(config.learning_rate, config.learning_rate * config.final_learning_rate, steps)
        return optax.chain(optax.clip_by_global_norm(config.gradient_norm), optax.adam(rate, eps=1e-5))


def _summary(lesson: Lesson, networks: ActorCritic) -> Metrics:
    """How the rollout went, before it was learnt from."""
    rollout = lesson.rollout
    return {
        "reward": rollout.reward.mean(),
        "error_x_n": rollout.error[..., 0].mean(),
        "error_y_n": rollout.error[..., 1].mean(),
        "deviation": jnp.exp(networks.policy.log_deviation).mean(),
        "explained": 1 - jnp.var(lesson.target - rollout.value) / (jnp.var(lesson.target) + 1e-8),
    }
