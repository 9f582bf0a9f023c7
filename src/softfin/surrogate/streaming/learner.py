"""The updates of an ensemble, compiled once: stretches in, all members' weights a step further, side by side."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.surrogate.streaming.config import StreamingConfig
from softfin.surrogate.streaming.drive import DriveNet
from softfin.surrogate.streaming.force import ForceNet, Motion
from softfin.surrogate.streaming.member import forces, motions
from softfin.surrogate.streaming.sequences import Stretch, Table, slicer

UPDATES_A_CALL = 50

WARM_UP = 100
"""Updates in which the learning rate rises."""

Loss = Callable[[Any, Stretch, Motion, Float[Array, ""], PRNGKeyArray], Float[Array, ""]]
"""Of one member: (net, stretch, predicted motion from its `before` on, part of the training that is done, key)."""


class Learning(NamedTuple):
    """All that a resumed run needs of one kind of net; arrays have a leading axis ``members``."""

    nets: Any
    optimiser: Any
    best: Any
    best_loss: Float[Array, "members"]


class Learner:
    """Of one kind of net."""

    def __init__(self, loss: Loss, config: StreamingConfig, updates: int) -> None:
        self.loss, self.config, self.updates = loss, config, updates
        rate = config.learning_rate
        schedule = optax.warmup_cosine_decay_schedule(0.0, rate, min(WARM_UP, updates // 4), updates, rate / 100)
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self.run = eqx.filter_jit(self._run)

    def start(self, nets: Any) -> Learning:
        """Fresh."""
        # With its type, or the second call would be compiled anew.
        worst = jnp.full(self.config.members, jnp.inf, jnp.float32)
        return Learning(nets, jax.jit(jax.vmap(self.optimiser.init))(nets), nets, worst)

    def _run(
        self, learning: Learning, table: Table, predicted: Motion, first: Int[Array, ""], count: int, key: PRNGKeyArray
    ) -> tuple[Learning, Float[Array, "members"]]:
        """`count` updates (static), of which `first` is the first; out come the members' mean losses."""

        def member(net: Any, optimiser: Any, predicted: Motion, number: Array, key: PRNGKeyArray) -> Any:
            draw, key = jax.random.split(key)
            stretch = table.draw(draw, self.config.batch, self.config.ticks)
            foretold = jax.tree.map(slicer(stretch.starts, self.config.ticks + 1), predicted)
            loss, slope = jax.value_and_grad(self.loss)(net, stretch, foretold, number / self.updates, key)
            step, optimiser = self.optimiser.update(slope, optimiser, net)
            return optax.apply_updates(net, step), optimiser, loss

        def update(carry: Any, number: Int[Array, ""]) -> Any:
            nets, optimiser = carry
            keys = jax.random.split(jax.random.fold_in(key, number), self.config.members)
            nets, optimiser, loss = jax.vmap(member, in_axes=(0, 0, 0, None, 0))(
                nets, optimiser, predicted, number, keys
            )
            return (nets, optimiser), loss

        carry = learning.nets, learning.optimiser
        (nets, optimiser), losses = jax.lax.scan(update, carry, first + jnp.arange(count))
        return learning._replace(nets=nets, optimiser=optimiser), losses.mean(axis=0)


@eqx.filter_jit
def keep_best(learning: Learning, loss: Float[Array, "members"]) -> Learning:
    """Each member's weights with the least held-out loss so far."""
    better = loss < learning.best_loss

    def pick(new: Array, old: Array) -> Array:
        return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    best = jax.tree.map(pick, learning.nets, learning.best)
    return learning._replace(best=best, best_loss=jnp.minimum(loss, learning.best_loss))


def drive_loss(config: StreamingConfig) -> Loss:
    """Mean square of the errors of angle and velocity, each in its own unit: free-running from the first tick on."""

    def loss(net: DriveNet, stretch: Stretch, _: Motion, __: Array, ___: PRNGKeyArray) -> Float[Array, ""]:
        said = jax.vmap(lambda *of: motions(net, *of))(stretch.before, stretch.waiting, stretch.commands)
        angle = (said.angle - stretch.motion.angle) / net.scales.angle_rad
        velocity = (said.velocity - stretch.motion.velocity) / net.scales.velocity_rad_s
        return jnp.mean((angle**2 + velocity**2)[:, config.burn_in :])

    return loss


def force_loss(config: StreamingConfig) -> Loss:
    """Mean square error of the force in units of its scale, or the Gaussian likelihood's where deviations are learnt.

    A stretch is fed with the measured motion at first, and with the drive net's in the end: in between, with the
    probability that grows from 0 to 1 over the `free_running` part of the training.
    """
    begin, end = config.free_running

    def loss(net: ForceNet, stretch: Stretch, foretold: Motion, done: Array, key: PRNGKeyArray) -> Float[Array, ""]:
        share = jnp.clip((done - begin) / jnp.maximum(end - begin, 1e-6), 0.0, 1.0)
        freed = jax.random.bernoulli(key, share, (config.batch, 1))
        measured = jax.tree.map(lambda x, y: jnp.concatenate([x[:, None], y], axis=1), stretch.before, stretch.motion)
        motion = jax.tree.map(lambda new, old: jnp.where(freed, new, old), foretold, measured)
        before, after = jax.tree.map(lambda x: x[:, 0], motion), jax.tree.map(lambda x: x[:, 1:], motion)
        said = jax.vmap(lambda *of: forces(net, *of))(before, after)
        error = jnp.sum(((said.force - stretch.force) / net.scales.force_n) ** 2, axis=-1)[:, config.burn_in :]
        if not net.config.heteroscedastic:
            return jnp.mean(error)
        log_deviation = said.log_deviation[:, config.burn_in :]
        # Of two independent axes, less the constant.
        return jnp.mean(error * jnp.exp(-2 * log_deviation) / 2 + 2 * log_deviation)

    return loss
