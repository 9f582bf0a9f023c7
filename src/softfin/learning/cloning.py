"""Behaviour cloning: a policy begins as a copy of a table of gaits, so that gradients only have to correct its errors.

A gait's action depends on the reference and the phase alone, so the expert action is defined in every state.
"""

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
from softfin.gaits.gait import GaitTable
from softfin.learning.policy import Policy
from softfin.task.references import References
from softfin.task.task import ForceTracking, TaskState


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
