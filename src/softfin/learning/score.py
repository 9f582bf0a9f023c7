"""What counts in the end: a policy without its exploration noise, from rest, judged as the paper's Table II judges."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.action_clock import ticks_of
from softfin.core.plant import Ticks, counted
from softfin.core.quantities import AnyArray
from softfin.core.window import moving_average, moving_error
from softfin.learning.policy import Policy
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.task.references import References
from softfin.task.task import ForceTracking


class Score(NamedTuple):
    """Of an episode per reference."""

    error: Float[AnyArray, "references 2"]
    """Mean over all whole windows of |moving average - reference| [N]."""
    deviation: Float[AnyArray, "references 2"]
    """Standard deviation of the moving average [N]."""
    beyond: Float[AnyArray, "references"] | None = None
    """Share of the actions that led beyond the training data of a plant that knows its `distance`; None of others."""


def score(task: ForceTracking, policy: Policy, references: Float[Array, "references 2"], key: PRNGKeyArray) -> Score:
    """One episode from rest for each reference, all side by side; the reference stays."""
    count, window = len(references), task.config.window_samples
    states = jax.vmap(task.reset)(jax.random.split(key, count), References(references, references, None))
    memories = jax.tree.map(lambda x: jnp.tile(x, (count, 1)), policy.init())

    plant = task.plant if isinstance(task.plant, StreamingSurrogate) else None

    def act(carry: tuple[Any, Any], ticks: Ticks) -> tuple[tuple[Any, Any], tuple[Array, Array]]:
        states, memories = carry
        memories, actions = jax.vmap(policy.act)(memories, jax.vmap(task.observe)(states))
        states, outcome = jax.vmap(partial(task.step, ticks=ticks))(states, actions)
        distance = jnp.zeros(count) if plant is None else jax.vmap(plant.distance)(states.plant)
        return (states, memories), (jnp.swapaxes(outcome.forces, 0, 1), distance)

    actions = task.config.episode_actions
    _, (forces, distances) = jax.lax.scan(act, (states, memories), jnp.asarray(ticks_of(actions)))
    series = jnp.swapaxes(counted(forces, actions), 0, 1)
    beyond = None if plant is None else (distances > 1).mean(axis=0)
    error, average = moving_error(series, references[:, None], window), moving_average(series, window)
    return Score(error, average.std(axis=-2), beyond)
