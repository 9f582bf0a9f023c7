"""How an ensemble of streaming nets learns: configuration, losses, and the updates of all members side by side."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field, PositiveInt, model_validator

from softfin.core.configuration import Configuration
from softfin.surrogate.streaming.drive import DriveNetConfig, FollowingNet
from softfin.surrogate.streaming.force import ForceNet, ForceNetConfig, Motion
from softfin.surrogate.streaming.member import forces, motions
from softfin.surrogate.streaming.segments import SegmentBatch, Table, slices
from softfin.surrogate.training import TrainingState

WARM_UP = 100
"""Updates in which the learning rate rises."""

Loss = Callable[[Any, SegmentBatch, Motion, Float[Array, ""], PRNGKeyArray], Float[Array, ""]]
"""Loss of one member: (net, segments, predicted motion from their `before` on, part of the training done, key)."""


class StreamingConfig(Configuration):
    """How an ensemble of nets with a state of their own is fitted; docs/surrogates.md measures the choices."""

    drive: DriveNetConfig = DriveNetConfig()
    """Commands to motion."""
    force: ForceNetConfig = ForceNetConfig()
    """Motion to force."""
    members: PositiveInt = 5
    """Members of the ensemble, trained side by side from different weights on different segments."""
    drive_updates: PositiveInt = 600
    """Updates of the drive nets; the learning rate falls to a hundredth over them (cosine)."""
    force_updates: PositiveInt = 2000
    """Updates of the force nets, likewise."""
    batch: PositiveInt = 32
    """Segments of the logs an update and member."""
    ticks: int = Field(default=400, ge=2)
    """Length of a segment [10 ms]; gradients go back through all of it."""
    burn_in: int = Field(default=100, ge=0)
    """Ticks at the beginning of a segment whose errors do not count: what was before it is not known."""
    learning_rate: float = Field(default=3e-3, gt=0)
    """Greatest learning rate of Adam."""
    free_running: tuple[float, float] = (0.2, 0.8)
    """Parts of the force nets' training between which they change from the measured to the predicted motion."""
    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Share of the training logs kept for choosing weights and calibrating intervals; at least one log."""

    @model_validator(mode="after")
    def _in_order(self) -> "StreamingConfig":
        if self.burn_in >= self.ticks:
            raise ValueError(f"burn_in must be less than ticks = {self.ticks}, or no error counts")
        if not 0 <= self.free_running[0] <= self.free_running[1] <= 1:
            raise ValueError("free_running must be two parts of the training in order, such as 0.2, 0.8")
        return self


class StreamingLearner:
    """The updates of one kind of net, compiled once: all members' weights a step further, side by side."""

    def __init__(self, loss: Loss, config: StreamingConfig, updates: int) -> None:
        self.loss, self.config, self.updates = loss, config, updates
        rate = config.learning_rate
        schedule = optax.warmup_cosine_decay_schedule(0.0, rate, min(WARM_UP, updates // 4), updates, rate / 100)
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self.run = eqx.filter_jit(self._run)

    def start(self, nets: Any) -> TrainingState:
        """State before the first update."""
        # With its type, or the second call would be compiled anew.
        worst = jnp.full(self.config.members, jnp.inf, jnp.float32)
        return TrainingState(nets, jax.jit(jax.vmap(self.optimiser.init))(nets), nets, worst)

    def _run(
        self, state: TrainingState, table: Table, predicted: Motion, first: Int[Array, ""], count: int,
        key: PRNGKeyArray,
    ) -> tuple[TrainingState, Float[Array, "members"]]:  # fmt: skip
        """`count` updates (static), of which `first` is the first; also returns the members' mean losses."""

        def member(net: Any, optimiser: Any, predicted: Motion, number: Array, key: PRNGKeyArray) -> Any:
            draw, key = jax.random.split(key)
            segments = table.draw(draw, self.config.batch, self.config.ticks)
            motion = slices(predicted, segments.starts, self.config.ticks + 1)
            loss, slope = jax.value_and_grad(self.loss)(net, segments, motion, number / self.updates, key)
            step, optimiser = self.optimiser.update(slope, optimiser, net)
            return optax.apply_updates(net, step), optimiser, loss

        def update(carry: Any, number: Int[Array, ""]) -> Any:
            keys = jax.random.split(jax.random.fold_in(key, number), self.config.members)
            nets, optimiser = carry
            each = jax.vmap(member, in_axes=(0, 0, 0, None, 0))
            nets, optimiser, loss = each(nets, optimiser, predicted, number, keys)
            return (nets, optimiser), loss

        (nets, optimiser), losses = jax.lax.scan(update, (state.nets, state.optimiser), first + jnp.arange(count))
        return state._replace(nets=nets, optimiser=optimiser), losses.mean(axis=0)


def drive_loss(config: StreamingConfig) -> Loss:
    """Mean square of the errors of angle and velocity, each in its own unit: free-running from the first tick on."""

    def loss(net: FollowingNet, segments: SegmentBatch, _: Motion, __: Array, ___: PRNGKeyArray) -> Float[Array, ""]:
        predicted = jax.vmap(lambda *of: motions(net, *of))(segments.before, segments.waiting, segments.commands)
        angle = (predicted.angle - segments.motion.angle) / net.scales.angle_rad
        velocity = (predicted.velocity - segments.motion.velocity) / net.scales.velocity_rad_s
        return jnp.mean((angle**2 + velocity**2)[:, config.burn_in :])

    return loss


def force_loss(config: StreamingConfig) -> Loss:
    """Mean square error of the force over its scale.

    A segment gets the measured motion at first, and the drive net's in the end: in between, with the probability that
    grows from 0 to 1 over the `free_running` part of the training.
    """
    begin, end = config.free_running

    def loss(
        net: ForceNet, segments: SegmentBatch, predicted: Motion, done: Array, key: PRNGKeyArray
    ) -> Float[Array, ""]:
        share = jnp.clip((done - begin) / jnp.maximum(end - begin, 1e-6), 0.0, 1.0)
        free = jax.random.bernoulli(key, share, (config.batch, 1))
        measured = jax.tree.map(lambda x, y: jnp.concatenate([x[:, None], y], axis=1), segments.before, segments.motion)
        motion = jax.tree.map(lambda new, old: jnp.where(free, new, old), predicted, measured)
        before, after = jax.tree.map(lambda x: x[:, 0], motion), jax.tree.map(lambda x: x[:, 1:], motion)
        force = jax.vmap(lambda *of: forces(net, *of))(before, after)
        error = jnp.sum(((force - segments.force) / net.scales.force_n) ** 2, axis=-1)
        return jnp.mean(error[:, config.burn_in :])

    return loss
