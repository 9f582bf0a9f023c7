"""Rollouts: a policy acts with its noise in a batch of environments; what it lived through goes to the learner.

Environments are in phase on the 33/33/34 clock: a rollout is a scan over cycles of three actions, and each action is
one vmapped call of the plant.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from softfin.core.action_clock import ACTION_TICKS
from softfin.core.plant import Ticks
from softfin.learning.lstm import Memory, cleared
from softfin.learning.policy import Policy
from softfin.task.references import References
from softfin.task.task import ForceTracking, TaskState


class Batch(NamedTuple):
    """A lane's environments between two actions; every leaf has a leading axis of environments."""

    states: TaskState
    memories: Memory
    """What the policy remembers of the observations before this one."""
    fresh: Bool[Array, "environments"]
    """Whether the environment was just reset, so that the memory is of another episode."""


class Rollout(NamedTuple):
    """What the environments lived through, ``(time, environments, ...)``."""

    observation: Float[Array, "*batch observations"]
    raw: Float[Array, "*batch actions"]
    """Actions before the squashing."""
    log_density: Float[Array, "*batch"]
    reward: Float[Array, "*batch"]
    error: Float[Array, "*batch 2"]
    """|F_e| of the window [N]."""
    seen: Float[Array, "*batch seen"]
    """What the critic sees before the action."""
    seen_after: Float[Array, "*batch seen"]
    """And after it, before any reset."""
    fresh: Bool[Array, "*batch"]
    """Whether the environment was reset just before the action."""
    cut: Bool[Array, "*batch"]
    """Whether the episode was cut just after it."""


def begin(task: ForceTracking, policy: Policy, references: References, key: PRNGKeyArray, count: int) -> Batch:
    """Fins at rest; their first episodes are shorter by whole cycles, so that later resets are spread over time."""
    states = jax.vmap(task.reset, (0, None))(jax.random.split(key, count), references)
    cycles = task.config.episode_actions // len(ACTION_TICKS)
    age = jnp.arange(count) * cycles // count * len(ACTION_TICKS)
    memories = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), policy.init())
    return Batch(states._replace(age=age.astype(jnp.int32)), memories, jnp.ones(count, bool))


def collect(task: ForceTracking, policy: Policy, batch: Batch, key: PRNGKeyArray, cycles: int) -> tuple[Batch, Rollout]:
    """`cycles` x 3 actions in every environment, which start again when their episodes are over."""

    def cycle(batch: Batch, noise: Float[Array, "3 environments actions"]) -> tuple[Batch, Rollout]:
        held = (noise, jnp.asarray(ACTION_TICKS))
        batch, steps = jax.lax.scan(lambda batch, now: _act(task, policy, batch, *now), batch, held)
        batch = restart(task, batch)
        return batch, steps._replace(cut=steps.cut.at[-1].set(batch.fresh))

    noise = jax.random.normal(key, (cycles, len(ACTION_TICKS), len(batch.fresh), len(policy.log_deviation)))
    batch, rollout = jax.lax.scan(cycle, batch, noise)
    return batch, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)


def _act(
    task: ForceTracking, policy: Policy, batch: Batch, noise: Float[Array, "environments actions"], ticks: Ticks
) -> tuple[Batch, Rollout]:
    memories = jax.vmap(cleared)(batch.memories, batch.fresh)
    observation = jax.vmap(task.observe)(batch.states)
    memories, mean = jax.vmap(policy.step)(memories, observation)
    raw = mean + jnp.exp(policy.log_deviation) * noise
    states, outcome = jax.vmap(partial(task.step, ticks=ticks))(batch.states, jnp.tanh(raw))
    never = jnp.zeros_like(batch.fresh)
    step = Rollout(
        observation=observation,
        raw=raw,
        log_density=policy.log_density(mean, raw),
        reward=outcome.reward,
        error=outcome.error,
        seen=jax.vmap(task.inspect)(batch.states),
        seen_after=jax.vmap(task.inspect)(states),
        fresh=batch.fresh,
        cut=never,
    )
    return Batch(states, memories, never), step


def restart(task: ForceTracking, batch: Batch) -> Batch:
    """Where episodes are over, the fins at rest again."""
    cut = jax.vmap(task.finished)(batch.states)
    again = jax.vmap(task.reset)(batch.states.key, batch.states.references)
    return Batch(jax.tree.map(partial(_choose, cut), again, batch.states), batch.memories, cut)


def _choose(where: Bool[Array, "environments"], new: Any, old: Any) -> Any:
    """`new` where true; keys of the random generator go as numbers."""
    if jnp.issubdtype(new.dtype, jax.dtypes.prng_key):
        numbers = _choose(where, jax.random.key_data(new), jax.random.key_data(old))
        return jax.random.wrap_key_data(numbers)
    return jnp.where(where.reshape(-1, *[1] * (new.ndim - 1)), new, old)
