"""Imitation: a policy begins as a copy of a table of gaits, so that gradients only have to mend what it gets wrong.

A gait's action depends on the reference and the phase alone, so the label of any state is known, whoever led there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import CYCLE_ACTIONS, ticks_of
from softfin.core.configuration import Configuration
from softfin.core.plant import Ticks
from softfin.gaits.gait import GaitTable
from softfin.learning.lstm import Memory
from softfin.learning.policy import Policy
from softfin.task.references import References
from softfin.task.task import ForceTracking, TaskState


class ImitationConfig(Configuration):
    """How a policy is taught."""

    fins: PositiveInt = 192
    """Fins that the gaits move, each with two references, one after the other."""
    actions: int = Field(default=36, ge=12, multiple_of=6)
    """Actions of each fin; the reference changes in the middle."""
    steps: PositiveInt = 1200
    """Of Adam, each over `batch` fins."""
    batch: PositiveInt = 48
    """Fins of one step."""
    learning_rate: PositiveFloat = 4e-3
    """At the start; it falls as a cosine to nothing."""


class Shown(NamedTuple):
    """What was observed and what the gait did, ``(time, fins, ...)``."""

    observation: Float[Array, "*batch observations"]
    action: Float[Array, "*batch 2"]


def imitate(
    task: ForceTracking, policy: Policy, table: GaitTable, references: References, key: PRNGKeyArray,
    config: ImitationConfig,
) -> Policy:  # fmt: skip
    """The policy, taught what the table does for references from the box."""
    show_key, draw_key = jax.random.split(key)
    shown = show(task, table, references, show_key, config)
    schedule = optax.cosine_decay_schedule(config.learning_rate, config.steps)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    fresh = jnp.zeros(config.actions, bool)

    def loss(policy: Policy, chosen: Shown) -> Float[Array, ""]:
        start: Memory = jax.tree.map(lambda x: jnp.tile(x, (chosen.action.shape[1], 1)), policy.init())
        said = jax.vmap(policy.sequence, in_axes=(0, 1, None), out_axes=1)(start, chosen.observation, fresh)
        return jnp.mean((jnp.tanh(said) - chosen.action) ** 2)

    def step(carry: tuple[Policy, optax.OptState], key: PRNGKeyArray) -> tuple[tuple[Policy, optax.OptState], None]:
        policy, state = carry
        fins = jax.random.choice(key, config.fins, (min(config.batch, config.fins),), replace=False)
        slope = jax.grad(loss)(policy, jax.tree.map(lambda x: x[:, fins], shown))
        change, state = optimiser.update(slope, state)
        return (optax.apply_updates(policy, change), state), None

    keys = jax.random.split(draw_key, config.steps)
    (policy, _), _ = jax.lax.scan(step, (policy, optimiser.init(policy)), keys)
    return policy


def show(
    task: ForceTracking, table: GaitTable, references: References, key: PRNGKeyArray, config: ImitationConfig
) -> Shown:
    """The table at work from rest."""
    reset_key, change_key = jax.random.split(key)
    states = jax.vmap(task.reset, (0, None))(jax.random.split(reset_key, config.fins), references)
    later = jax.vmap(references.draw)(jax.random.split(change_key, config.fins))

    def act(state: TaskState, later: Float[Array, "2"], half: Bool[Array, ""], ticks: Ticks) -> tuple[TaskState, Shown]:
        state = state._replace(reference=jnp.where(half, later, state.reference))
        action = table.gait(state.reference)[state.age % CYCLE_ACTIONS]
        return task.step(state, action, ticks)[0], Shown(task.observe(state), action)

    ticks = jnp.asarray(ticks_of(config.actions))
    each = jax.vmap(act, (0, 0, None, None))
    half = jnp.arange(config.actions) >= config.actions // 2
    _, shown = jax.lax.scan(lambda states, now: each(states, later, *now), states, (half, ticks))
    return shown
