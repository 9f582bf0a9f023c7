"""Gradient training: the force error of whole rollouts is differentiated through the plant into the policy.

Truncated backpropagation through time, the short horizon of Xu et al. 2022 (SHAC) without its critic: the fin forgets
within two or three seconds, and the window of the reward holds two, so a rollout of six seconds sees nearly all that an
action does. Pure; one lane, `vmap` adds lanes.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field, PositiveFloat, PositiveInt

from softfin.core.action_clock import ticks_of
from softfin.core.configuration import Configuration
from softfin.core.plant import Ticks
from softfin.gaits.force_map import MapConfig
from softfin.gaits.gait import GaitTable
from softfin.learning.imitation import ImitationConfig, imitate
from softfin.learning.learner import Metrics, clipped_adam
from softfin.learning.lstm import cleared
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import Batch, begin, restart
from softfin.task.references import References
from softfin.task.task import ForceTracking, Outcome


class CommonConfig(Configuration):
    """One policy for all cells of a grid, from which theirs begin."""

    updates: PositiveInt = 120
    """Of its own."""
    environments: PositiveInt = 32
    """Fins that it beats side by side."""
    learning_rate: PositiveFloat = 1e-3
    """Of Adam, at its greatest."""
    lattice: PositiveInt = 3
    """Scored are lattice x lattice references over all cells."""


class GradientConfig(Configuration):
    """The learner."""

    environments: PositiveInt = 32
    """Fins that each policy beats side by side."""
    rollout_actions: int = Field(default=18, ge=3, multiple_of=3)
    """Actions between updates, whole cycles of three; gradients reach back as far."""
    learning_rate: PositiveFloat = 1e-3
    """Of Adam, at its greatest."""
    final_learning_rate: float = Field(default=0.01, ge=0, le=1)
    """At the end, as a part of the greatest; it falls as a cosine."""
    gradient_norm: PositiveFloat = 1.0
    """Longer gradients are scaled down to this."""
    rounding_n: PositiveFloat = 0.05
    """Force errors below this weigh as their squares [N]: near 0 the sign of an error tells too little."""
    teacher: bool = True
    """Whether the policy begins as a copy of a table of gaits."""
    map: MapConfig = MapConfig()
    """How the table is found; its box is the least one round all cells."""
    imitation: ImitationConfig = ImitationConfig()
    """How it is copied."""
    common: CommonConfig | None = None
    """Of a grid: train one policy for all cells first, and begin from it; none: each cell from the gaits."""

    @property
    def steps_per_update(self) -> int:
        """Actions over all environments."""
        return self.environments * self.rollout_actions


class GradientLane(NamedTuple):
    """Everything that one policy's training carries from update to update."""

    policy: Policy
    optimiser: Any
    batch: Batch
    key: PRNGKeyArray


@dataclass(frozen=True)
class Gradient:
    """The learner for a task, over a number of updates."""

    task: ForceTracking
    config: GradientConfig
    policy: PolicyConfig
    updates: int
    teacher: GaitTable | None = None

    def init(self, key: PRNGKeyArray, references: References) -> GradientLane:
        """A new policy, fins at rest."""
        network_key, batch_key, teach_key, key = jax.random.split(key, 4)
        policy = Policy.create(network_key, self.policy, self.task.config.observations)
        if self.teacher is not None:
            policy = imitate(self.task, policy, self.teacher, references, teach_key, self.config.imitation)
        batch = begin(self.task, policy, references, batch_key, self.config.environments)
        return GradientLane(policy, self._optimiser().init(policy), batch, key)

    def update(self, lane: GradientLane) -> tuple[GradientLane, Metrics]:
        """A rollout without noise, and one step down the gradient of its loss."""
        gradient, (batch, metrics) = jax.grad(self.loss, has_aux=True)(lane.policy, lane.batch)
        change, optimiser = self._optimiser().update(gradient, lane.optimiser, lane.policy)
        policy = optax.apply_updates(lane.policy, change)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        return GradientLane(policy, optimiser, restart(self.task, batch), lane.key), metrics

    def loss(self, policy: Policy, batch: Batch) -> tuple[Float[Array, ""], tuple[Batch, Metrics]]:
        """What the task's reward lacks of 0, a mean over the rollout, with force errors rounded near 0 [N]."""
        task = self.task

        def act(batch: Batch, ticks: Ticks) -> tuple[Batch, Outcome]:
            memories = jax.vmap(cleared)(batch.memories, batch.fresh)
            memories, action = jax.vmap(policy.act)(memories, jax.vmap(task.observe)(batch.states))
            states, outcome = jax.vmap(partial(task.step, ticks=ticks))(batch.states, action)
            return Batch(states, memories, jnp.zeros_like(batch.fresh)), outcome._replace(forces=jnp.zeros(()))

        batch, outcome = jax.lax.scan(act, batch, jnp.asarray(ticks_of(self.config.rollout_actions)))
        rounding = self.config.rounding_n
        rounded = jnp.sqrt(outcome.error**2 + rounding**2) - rounding
        loss = -task.config.reward.value(rounded, outcome.smoothness, outcome.disagreement).mean()
        x, y = outcome.error.mean(axis=(0, 1))
        return loss, (batch, {"loss": loss, "reward": outcome.reward.mean(), "error_x_n": x, "error_y_n": y})

    def _optimiser(self) -> optax.GradientTransformation:
        config = self.config
        rate = optax.cosine_decay_schedule(config.learning_rate, self.updates, config.final_learning_rate)
        return clipped_adam(rate, config.gradient_norm)
