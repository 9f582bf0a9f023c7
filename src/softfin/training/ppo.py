"""LSTM-PPO (Schulman et al. 2017) on one lane: collect, advantages, epochs of clipped updates. Pure; `jax.vmap` adds lanes.

A lane is one policy with its own key and its own distribution of references. Environments are in phase on the
33/33/34 clock, so a rollout is a scan over cycles of three actions and each action is one vmapped call of the plant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from softfin.configuration import Configuration
from softfin.plant import ACTION_TICKS
from softfin.tracking.references import References
from softfin.tracking.task import ForceTracking, TaskState
from softfin.training.lstm import Memory, cleared
from softfin.training.policy import ActorCritic, PolicyConfig

Metrics: TypeAlias = dict[str, Float[Array, ""]]


class PPOConfig(Configuration):
    """The learner. Tuned for the paper's budgets: a few tens of updates, each squeezed hard."""

    environments: PositiveInt = 16
    rollout_actions: int = Field(30, ge=3, multiple_of=3)
    epochs: PositiveInt = 10
    minibatches: PositiveInt = 4
    learning_rate: PositiveFloat = 1e-3
    final_learning_rate: float = Field(0.1, ge=0, le=1)
    discount: float = Field(0.9, gt=0, lt=1)
    trace: float = Field(0.95, ge=0, le=1)
    clip: PositiveFloat = 0.2
    entropy: NonNegativeFloat = 0.0
    value_weight: PositiveFloat = 0.5
    gradient_norm: PositiveFloat = 0.5


class Memories(NamedTuple):
    actor: Memory
    critic: Memory


class Rollout(NamedTuple):
    """What a batch of environments lived through, ``(time, environments, ...)``."""

    observation: Float[Array, "*batch observations"]
    seen: Float[Array, "*batch seen"]
    raw: Float[Array, "*batch actions"]
    """Actions before the squashing."""
    log_density: Float[Array, "*batch"]
    value: Float[Array, "*batch"]
    reward: Float[Array, "*batch"]
    error: Float[Array, "*batch 2"]
    fresh: Bool[Array, "*batch"]
    """Whether the environment was reset just before."""
    cut: Bool[Array, "*batch"]
    """Whether the episode was cut just after."""
    beyond: Float[Array, "*batch"]
    """Value of the state after a cut, from before the reset; 0 elsewhere."""


class Lane(NamedTuple):
    """Everything that one lane carries from update to update."""

    networks: ActorCritic
    optimiser: Any
    environments: TaskState
    memories: Memories
    fresh: Bool[Array, "environments"]
    references: References
    key: PRNGKeyArray
    updates: Int[Array, ""]


@dataclass(frozen=True)
class PPO:
    task: ForceTracking
    config: PPOConfig
    policy: PolicyConfig
    updates: int

    @property
    def steps_per_update(self) -> int:
        return self.config.environments * self.config.rollout_actions

    def init(self, key: PRNGKeyArray, references: References) -> Lane:
        network_key, reset_key, age_key, key = jax.random.split(key, 4)
        count = self.config.environments
        environments = jax.vmap(self.task.reset, (0, None))(jax.random.split(reset_key, count), references)
        one = jax.tree.map(lambda x: x[0], environments)
        networks = ActorCritic.create(
            network_key, self.policy, len(self.task.observe(one)), len(self.task.inspect(one))
        )
        memory = Memories(networks.policy.init(), networks.critic.init())
        memories = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), memory)
        age = 3 * ((jnp.arange(count) * (self.task.config.episode_actions // 3)) // count)
        environments = environments._replace(age=age.astype(jnp.int32))
        return Lane(
            networks,
            self._optimiser().init(networks),
            environments,
            memories,
            jnp.ones(count, bool),
            references,
            key,
            jnp.int32(0),
        )

    def update(self, lane: Lane) -> tuple[Lane, Metrics]:
        key, collect_key, learn_key = jax.random.split(lane.key, 3)
        memories = lane.memories
        lane, rollout = self.collect(lane, collect_key)
        last = self._values(lane)
        advantage = advantages(rollout, last, self.config.discount, self.config.trace)
        target = advantage + rollout.value
        networks, optimiser, metrics = self.learn(lane, rollout, memories, advantage, target, learn_key)
        metrics |= {
            "reward": rollout.reward.mean(),
            "error_x_n": rollout.error[..., 0].mean(),
            "error_y_n": rollout.error[..., 1].mean(),
            "deviation": jnp.exp(networks.policy.log_deviation).mean(),
            "explained": 1 - jnp.var(target - rollout.value) / jnp.var(target),
        }
        return lane._replace(networks=networks, optimiser=optimiser, key=key, updates=lane.updates + 1), metrics

    def collect(self, lane: Lane, key: PRNGKeyArray) -> tuple[Lane, Rollout]:
        networks = lane.networks
        scale = 1 - self.config.discount

        def act(carry, key, ticks, last):
            environments, memories, fresh = carry
            memories = jax.vmap(cleared)(memories, fresh)
            observation = jax.vmap(self.task.observe)(environments)
            seen = jax.vmap(self.task.inspect)(environments)
            actor, mean = jax.vmap(networks.policy.net.step)(memories.actor, observation)
            critic, value = jax.vmap(networks.critic.step)(memories.critic, seen)
            raw = mean + jnp.exp(networks.policy.log_deviation) * jax.random.normal(key, mean.shape)
            log_density = networks.policy.log_density(mean, raw)
            environments, outcome = jax.vmap(partial(self.task.step, ticks=ticks))(environments, jnp.tanh(raw))
            memories = Memories(actor, critic)
            cut = jax.vmap(self.task.finished)(environments)
            none = jnp.zeros_like(cut)
            beyond = jnp.zeros_like(value[:, 0])
            if last:
                _, after = jax.vmap(networks.critic.step)(critic, jax.vmap(self.task.inspect)(environments))
                beyond = jnp.where(cut, after[:, 0], 0.0)
                again = jax.vmap(self.task.reset, (0, None))(environments.key, lane.references)
                environments = jax.tree.map(partial(_where, cut), again, environments)
            else:
                cut = none
            step = Rollout(
                observation,
                seen,
                raw,
                log_density,
                value[:, 0],
                scale * outcome.reward,
                outcome.error,
                fresh,
                cut,
                beyond,
            )
            return (environments, memories, cut), step

        def cycle(carry, key):
            steps = []
            for i, (k, ticks) in enumerate(zip(jax.random.split(key, 3), ACTION_TICKS)):
                carry, step = act(carry, k, ticks, i == 2)
                steps.append(step)
            return carry, jax.tree.map(lambda *x: jnp.stack(x), *steps)

        keys = jax.random.split(key, self.config.rollout_actions // 3)
        carry = (lane.environments, lane.memories, lane.fresh)
        (environments, memories, fresh), rollout = jax.lax.scan(cycle, carry, keys)
        rollout = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)
        return lane._replace(environments=environments, memories=memories, fresh=fresh), rollout

    def _values(self, lane: Lane):
        memories = jax.vmap(cleared)(lane.memories.critic, lane.fresh)
        return jax.vmap(lane.networks.critic.step)(memories, jax.vmap(self.task.inspect)(lane.environments))[1][:, 0]

    def learn(self, lane, rollout, memories, advantage, target, key):
        optimiser = self._optimiser()
        count = self.config.environments

        def minibatch(carry, chosen):
            networks, state = carry
            pick = lambda x: x[:, chosen]
            batch = jax.tree.map(pick, (rollout, advantage, target))
            starts = jax.tree.map(lambda x: x[chosen], memories)
            (loss, metrics), gradient = jax.value_and_grad(self.loss, has_aux=True)(networks, *batch, starts)
            change, state = optimiser.update(gradient, state, networks)
            return (optax.apply_updates(networks, change), state), metrics | {
                "loss": loss,
                "gradient_norm": optax.global_norm(gradient),
            }

        def epoch(carry, key):
            order = jax.random.permutation(key, count).reshape(self.config.minibatches, -1)
            return jax.lax.scan(minibatch, carry, order)

        (networks, state), metrics = jax.lax.scan(
            epoch, (lane.networks, lane.optimiser), jax.random.split(key, self.config.epochs)
        )
        return networks, state, jax.tree.map(jnp.mean, metrics)

    def loss(self, networks, rollout: Rollout, advantage, target, starts: Memories):
        over = partial(jax.vmap, in_axes=(0, 1, 1), out_axes=1)
        mean = over(networks.policy.net.sequence)(starts.actor, rollout.observation, rollout.fresh)
        value = over(networks.critic.sequence)(starts.critic, rollout.seen, rollout.fresh)[..., 0]
        log_ratio = networks.policy.log_density(mean, rollout.raw) - rollout.log_density
        ratio = jnp.exp(log_ratio)
        normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        clipped = jnp.clip(ratio, 1 - self.config.clip, 1 + self.config.clip)
        gain = jnp.minimum(ratio * normal, clipped * normal).mean()
        value_loss = jnp.mean((value - target) ** 2)
        entropy = networks.policy.entropy()
        loss = -gain + self.config.value_weight * value_loss - self.config.entropy * entropy
        return loss, {
            "value_loss": value_loss,
            "kl": jnp.mean(ratio - 1 - log_ratio),
            "clipped": jnp.mean(jnp.abs(ratio - 1) > self.config.clip),
        }

    def _optimiser(self):
        c = self.config
        total = self.updates * c.epochs * c.minibatches
        rate = optax.linear_schedule(c.learning_rate, c.learning_rate * c.final_learning_rate, total)
        return optax.chain(optax.clip_by_global_norm(c.gradient_norm), optax.adam(rate, eps=1e-5))


def _where(where, new, old):
    if jnp.issubdtype(new.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_where(where, jax.random.key_data(new), jax.random.key_data(old)))
    return jnp.where(where.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def advantages(rollout: Rollout, last, discount: float, trace: float):
    """Generalised advantage estimation (Schulman et al. 2016); a cut is bootstrapped with the value beyond it."""

    def back(carry, now):
        following, following_value = carry
        value, reward, cut, beyond = now
        next_value = jnp.where(cut, beyond, following_value)
        error = reward + discount * next_value - value
        advantage = error + discount * trace * jnp.where(cut, 0.0, following)
        return (advantage, value), advantage

    steps = (rollout.value, rollout.reward, rollout.cut, rollout.beyond)
    return jax.lax.scan(back, (jnp.zeros_like(last), last), steps, reverse=True)[1]
