"""Rollouts: a policy acts with its noise in a batch of environments; what it lived through goes to the learner.

Environments are in phase on the 33/33/34 clock: a rollout is a scan over cycles of three actions, and each action is
one vmapped call of the plant.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from softfin.plant import ACTION_TICKS
from softfin.tracking.references import References
from softfin.tracking.task import ForceTracking, TaskState
from softfin.training.lstm import Memory, cleared
from softfin.training.policy import ActorCritic


class Memories(NamedTuple):
    """Of actor and critic."""

    actor: Memory
    critic: Memory


class Batch(NamedTuple):
    """A lane's environments between two actions; every leaf has a leading axis of environments."""

    states: TaskState
    memories: Memories
    """What the networks remember of the observations before this one."""
    fresh: Bool[Array, "environments"]
    """Whether the environment was just reset, so that the memories are of another episode."""


class Rollout(NamedTuple):
    """What the environments lived through, ``(time, environments, ...)``."""

    observation: Float[Array, "*batch observations"]
    seen: Float[Array, "*batch seen"]
    """What the critic sees."""
    raw: Float[Array, "*batch actions"]
    """Actions before the squashing."""
    log_density: Float[Array, "*batch"]
    value: Float[Array, "*batch"]
    reward: Float[Array, "*batch"]
    error: Float[Array, "*batch 2"]
    """|F_e| of the window [N]."""
    fresh: Bool[Array, "*batch"]
    """Whether the environment was reset just before this action."""
    cut: Bool[Array, "*batch"]
    """Whether the episode was cut just after it."""
    value_beyond: Float[Array, "*batch"]
    """Where the episode was cut, the value of the state that it was cut in; 0 elsewhere."""


def begin(task: ForceTracking, networks: ActorCritic, references: References, key: PRNGKeyArray, count: int) -> Batch:
    """Fins at rest; their first episodes are shorter by whole cycles, so that later resets are spread over time."""
    states = jax.vmap(task.reset, (0, None))(jax.random.split(key, count), references)
    cycles = task.config.episode_actions // len(ACTION_TICKS)
    age = jnp.arange(count) * cycles // count * len(ACTION_TICKS)
    memories = Memories(networks.policy.init(), networks.critic.init())
    return Batch(
        states._replace(age=age.astype(jnp.int32)),
        jax.tree.map(lambda x: jnp.tile(x, (count, 1)), memories),
        jnp.ones(count, bool),
    )


def collect(
    task: ForceTracking, networks: ActorCritic, batch: Batch, key: PRNGKeyArray, cycles: int
) -> tuple[Batch, Rollout]:
    """`cycles` x 3 actions in every environment, which start again when their episodes are over."""

    def cycle(batch: Batch, key: PRNGKeyArray) -> tuple[Batch, Rollout]:
        steps = []
        for ticks, noise_key in zip(ACTION_TICKS, jax.random.split(key, len(ACTION_TICKS)), strict=True):
            batch, step = _act(task, networks, batch, noise_key, ticks)
            steps.append(step)
        batch, cut, beyond = _restart(task, networks, batch)
        steps[-1] = steps[-1]._replace(cut=cut, value_beyond=beyond)
        return batch, jax.tree.map(lambda *parts: jnp.stack(parts), *steps)

    batch, rollout = jax.lax.scan(cycle, batch, jax.random.split(key, cycles))
    return batch, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)


def values(task: ForceTracking, networks: ActorCritic, batch: Batch) -> Float[Array, "environments"]:
    """What the critic expects from here on."""
    memories = jax.vmap(cleared)(batch.memories.critic, batch.fresh)
    return jax.vmap(networks.critic.step)(memories, jax.vmap(task.inspect)(batch.states))[1][:, 0]


def _act(
    task: ForceTracking, networks: ActorCritic, batch: Batch, key: PRNGKeyArray, ticks: int
) -> tuple[Batch, Rollout]:
    policy, critic = networks.policy, networks.critic
    memories = jax.vmap(cleared)(batch.memories, batch.fresh)
    observation, seen = jax.vmap(task.observe)(batch.states), jax.vmap(task.inspect)(batch.states)
    actor_memory, mean = jax.vmap(policy.net.step)(memories.actor, observation)
    critic_memory, value = jax.vmap(critic.step)(memories.critic, seen)
    raw = mean + jnp.exp(policy.log_deviation) * jax.random.normal(key, mean.shape)
    states, outcome = jax.vmap(partial(task.step, ticks=ticks))(batch.states, jnp.tanh(raw))
    never = jnp.zeros_like(batch.fresh)
    step = Rollout(
        observation, seen, raw, policy.log_density(mean, raw), value[:, 0], outcome.reward, outcome.error,
        fresh=batch.fresh, cut=never, value_beyond=jnp.zeros(len(never)),
    )  # fmt: skip
    return Batch(states, Memories(actor_memory, critic_memory), never), step


def _restart(
    task: ForceTracking, networks: ActorCritic, batch: Batch
) -> tuple[Batch, Bool[Array, "environments"], Float[Array, "environments"]]:
    """Where episodes are over: the fins at rest again, and the values of the states that were left."""
    cut = jax.vmap(task.finished)(batch.states)
    beyond = jnp.where(cut, values(task, networks, batch), 0.0)
    again = jax.vmap(task.reset)(batch.states.key, batch.states.references)
    states = jax.tree.map(partial(_choose, cut), again, batch.states)
    return Batch(states, batch.memories, cut), cut, beyond


def _choose(where: Bool[Array, "environments"], new: Any, old: Any) -> Any:
    """`new` where true; keys of the random generator go as numbers."""
    if jnp.issubdtype(new.dtype, jax.dtypes.prng_key):
        numbers = _choose(where, jax.random.key_data(new), jax.random.key_data(old))
        return jax.random.wrap_key_data(numbers)
    return jnp.where(where.reshape(-1, *[1] * (new.ndim - 1)), new, old)
