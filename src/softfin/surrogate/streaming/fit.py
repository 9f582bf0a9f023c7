"""Fits a streaming surrogate: profile, drive networks, force networks, then their error estimates,
in this order.

All members learn side by side. Force networks are trained on the motion that the drive networks
predict for whole logs, so that both are scored as they will be used: free-running, from the
commands alone.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt, model_validator

from softfin.core.action_clock import WINDOW
from softfin.core.compilation import jit
from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.progress import Progress
from softfin.core.quantities import Log, Reading, command_limits
from softfin.core.randomness import named_key
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.streaming.ensemble import (
    Member,
    calibrated,
    ensemble,
    familiar,
    forces,
    motions,
    predict_force,
    predict_motion,
)
from softfin.surrogate.streaming.nets import DriveNetConfig, FollowingNet, ForceNet, ForceNetConfig
from softfin.surrogate.streaming.profile import identify
from softfin.surrogate.streaming.segments import (
    Motion,
    Scales,
    SegmentBatch,
    Table,
    measure_scales,
    slices,
)
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.training import UPDATES_A_CALL, TrainingState, hold_out, keep_best_nets

WARM_UP = 100
"""Updates in which the learning rate rises."""

MAX_SCORINGS = 10
"""Times that a network is scored on the held-out logs while it is trained."""

NetLoss = Callable[
    [Any, SegmentBatch, Motion, Float[Array, ""], PRNGKeyArray, Any], Float[Array, ""]
]
"""Loss of one member: (net, segments, predicted motion, part of the training done, key, config)."""


class StreamingConfig(Configuration):
    """How an ensemble of networks with a state of their own is fitted; docs/surrogates.md measures
    the choices."""

    drive: DriveNetConfig = DriveNetConfig()
    """Commands to motion."""
    force: ForceNetConfig = ForceNetConfig()
    """Motion to force."""
    members: PositiveInt = 5
    """Members of the ensemble, trained side by side from different weights on different
    segments."""
    drive_updates: PositiveInt = 400
    """Updates of the drive networks; the learning rate falls to a hundredth over them (cosine)."""
    force_updates: PositiveInt = 2000
    """Updates of the force networks, likewise."""
    batch: PositiveInt = 16
    """Segments of the logs an update and member."""
    ticks: int = Field(default=250, ge=2)
    """Length of a segment [10 ms]; gradients go back through all of it."""
    burn_in: int = Field(default=80, ge=0)
    """Ticks at the beginning of a segment whose errors do not count: what was before it is not
    known."""
    learning_rate: float = Field(default=0.01, gt=0)
    """Greatest learning rate of Adam."""
    free_running: tuple[float, float] = (0.2, 0.8)
    """Parts of the force networks' training between which they change from the measured to the
    predicted motion."""
    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Share of the training logs kept for choosing weights and calibrating intervals; at least one
    log."""

    @model_validator(mode="after")
    def _in_order(self) -> "StreamingConfig":
        if self.burn_in >= self.ticks:
            raise ValueError(f"burn_in must be less than ticks = {self.ticks}, or no error counts")
        if not 0 <= self.free_running[0] <= self.free_running[1] <= 1:
            raise ValueError(
                "free_running must be two parts of the training in order, such as 0.2, 0.8"
            )
        return self


class StreamingLearner:
    """The updates of one kind of network, compiled once: all members' weights a step further, side
    by side."""

    def __init__(self, loss: NetLoss, config: StreamingConfig, updates: int) -> None:
        self.loss = loss
        self.config = config
        self.updates = updates
        rate = config.learning_rate
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, rate, min(WARM_UP, updates // 4), updates, rate / 100
        )
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self.run = jit("high")(self._run)

    def start(self, nets: PyTree) -> TrainingState:
        """State before the first update."""
        # With its type, or the second call would be compiled anew.
        worst = jnp.full(self.config.members, jnp.inf, jnp.float32)
        return TrainingState(nets, jax.jit(jax.vmap(self.optimiser.init))(nets), nets, worst)

    def _run(
        self,
        state: TrainingState,
        table: Table,
        predicted: Motion,
        first: Int[Array, ""],
        count: int,
        key: PRNGKeyArray,
    ) -> tuple[TrainingState, Float[Array, "members"]]:
        """`count` updates (static), of which `first` is the first; also returns the members' mean
        losses."""

        def member(
            net: PyTree, optimiser: PyTree, predicted: Motion, number: Array, key: PRNGKeyArray
        ) -> Any:
            draw, key = jax.random.split(key)
            segments = table.draw(draw, self.config.batch, self.config.ticks)
            motion = slices(predicted, segments.starts, self.config.ticks + 1)
            loss, slope = jax.value_and_grad(self.loss)(
                net, segments, motion, number / self.updates, key, self.config
            )
            step, optimiser = self.optimiser.update(slope, optimiser, net)
            return optax.apply_updates(net, step), optimiser, loss

        def update(carry: PyTree, number: Int[Array, ""]) -> Any:
            keys = jax.random.split(jax.random.fold_in(key, number), self.config.members)
            nets, optimiser = carry
            each = jax.vmap(member, in_axes=(0, 0, 0, None, 0))
            nets, optimiser, loss = each(nets, optimiser, predicted, number, keys)
            return (nets, optimiser), loss

        (nets, optimiser), losses = jax.lax.scan(
            update, (state.nets, state.optimiser), first + jnp.arange(count)
        )
        return state._replace(nets=nets, optimiser=optimiser), losses.mean(axis=0)


def motion_error(predicted: Motion, measured: Motion | Reading, scales: Scales) -> Any:
    """Square error of angle and velocity, each in its own unit."""
    angle = (predicted.angle - measured.angle) / scales.angle_rad
    velocity = (predicted.velocity - measured.velocity) / scales.velocity_rad_s
    return angle**2 + velocity**2


def drive_loss(
    net: FollowingNet,
    segments: SegmentBatch,
    _: Motion,
    __: Array,
    ___: PRNGKeyArray,
    config: StreamingConfig,
) -> Float[Array, ""]:
    """Mean of `motion_error`: free-running from the first tick on."""
    before = jax.tree.map(lambda x: x[:, 0], segments.motion)
    predicted = jax.vmap(partial(motions, net))(before, segments.waiting, segments.commands)
    return jnp.mean(motion_error(predicted, segments.motion, net.scales)[:, 1 + config.burn_in :])


def force_loss(
    net: ForceNet,
    segments: SegmentBatch,
    predicted: Motion,
    done: Array,
    key: PRNGKeyArray,
    config: StreamingConfig,
) -> Float[Array, ""]:
    """Mean square error of the force over its scale, given the measured motion of a segment or the
    drive network's.

    The latter with a probability that grows from 0 to 1 over the `free_running` part of the
    training.
    """
    begin, end = config.free_running
    share = jnp.clip((done - begin) / jnp.maximum(end - begin, 1e-6), 0.0, 1.0)
    free = jax.random.bernoulli(key, share, (config.batch, 1))
    motion = jax.tree.map(lambda new, old: jnp.where(free, new, old), predicted, segments.motion)
    error = (jax.vmap(partial(forces, net))(motion) - segments.force) / net.scales.force_n
    return jnp.mean(jnp.sum(error**2, axis=-1)[:, config.burn_in :])


def fit_streaming(
    logs: Sequence[Log],
    config: StreamingConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> StreamingSurrogate:
    """Fit an ensemble to the training logs; continue from the checkpoint in run_directory if there
    is one."""
    training, holding, scales, table = split_streaming(logs, config)
    start = jit("none")(ensemble)
    members = start(
        config.members, config.drive, config.force, scales, named_key(seed, "fit/weights")
    )
    updates = {"drive": config.drive_updates, "force": config.force_updates}
    losses: dict[str, NetLoss] = {"drive": drive_loss, "force": force_loss}
    learners = {
        name: StreamingLearner(loss, config, updates[name]) for name, loss in losses.items()
    }
    states = {name: learner.start(getattr(members, name)) for name, learner in learners.items()}
    done: dict[str, Any] = dict.fromkeys(learners, 0)
    if (resumed := run_directory.load(states)) is not None:
        states, done = resumed
    else:
        if progress is not None:
            progress("fit", 0.0, "identifying the drive's profile from the logs")
        profile = jax.tree.map(
            lambda x: jnp.full((config.members, *x.shape), x), identify(training, seed)[0]
        )
        nets = eqx.tree_at(lambda nets: nets.profile, states["drive"].nets, profile)
        states["drive"] = states["drive"]._replace(nets=nets, best=nets)
    record = run_directory.log(rewind_to=sum(done.values()))

    def learn(name: str, predicted: Motion, errors: Callable[[Any], list[np.ndarray]]) -> Any:
        """Do all updates of one kind of network; return the best by `errors` on held-out logs,
        ``(members, rows)``."""
        key = named_key(seed, f"fit/{name}")
        (call, round_of) = _calls(updates[name])
        before = updates["drive"] if name == "force" else 0
        while done[name] < updates[name]:
            state = states[name]
            losses = []
            until = min(done[name] + round_of, updates[name])
            for first in range(done[name], until, call):
                count = min(call, until - first)
                state, loss = learners[name].run(
                    state, table, predicted, jnp.int32(first), count, key
                )
                losses.append(loss)
                if progress is not None:
                    part = (before + first + count) / sum(updates.values())
                    progress("fit", part, f"{name} networks, loss {float(loss.mean()):.3g}")
            with np.errstate(over="ignore", invalid="ignore"):
                held_out = np.mean([each.mean(axis=1) for each in errors(state.nets)], axis=0)
            states[name], _ = keep_best_nets(state, losses, held_out, f"{name} networks")
            done[name] = until
            means = {f"train/{name}_loss": loss.mean(), f"held_out/{name}_mse": held_out.mean()}
            record.write(before + until, **jax.tree.map(float, means))
            run_directory.save(states, done)
        return states[name].best

    def drive_errors(nets: FollowingNet) -> list[np.ndarray]:
        each = zip(predict_motion(nets, holding), holding, strict=True)
        return [motion_error(predicted, log.reading, scales) for predicted, log in each]

    def force_errors(nets: ForceNet) -> list[np.ndarray]:
        each = zip(predict_force(nets, held_motion), holding, strict=True)
        return [((force - log.reading.force)[:, burn_in:] ** 2).sum(axis=-1) for force, log in each]

    not_used = Motion(*(jnp.zeros((config.members, table.force.shape[0])) for _ in range(2)))
    drives = learn("drive", not_used, drive_errors)
    motion = predict_motion(drives, training)
    joined = Motion(
        *(jnp.asarray(np.concatenate(parts, axis=1)) for parts in zip(*motion, strict=True))
    )
    held_motion = predict_motion(drives, holding)
    burn_in = config.burn_in
    force_nets = learn("force", joined, force_errors)
    record.close()
    interval = calibrated(predict_force(force_nets, held_motion), holding, burn_in)
    familiarity = familiar(force_nets, motion, burn_in)
    return StreamingSurrogate(
        Member(drives, force_nets), command_limits(training), interval, familiarity
    )


def split_streaming(
    logs: Sequence[Log], config: StreamingConfig
) -> tuple[Sequence[Log], list[Log], Scales, Table]:
    """Training and held-out logs, scales and table of the former; raises LogError where these
    cannot be fitted."""
    training, held_out = hold_out(logs, config.held_out)
    needed = config.burn_in + WINDOW
    holding = [log for log in held_out if len(log.reading.time) >= needed]
    if not holding:
        raise LogError(
            f"none of {len(held_out)} held-out logs has {needed} rows: intervals on the mean over "
            f"{WINDOW} samples behind burn_in = {config.burn_in} need as many; record longer"
        )
    return training, holding, measure_scales(training), Table.of(training, config.ticks)


def _calls(updates: int) -> tuple[int, int]:
    """Updates a call and a round: rounds of equal calls, so that one compiled program does all but
    the very last."""
    round_of = -(-updates // MAX_SCORINGS)
    calls = -(-round_of // UPDATES_A_CALL)
    call = -(-round_of // calls)
    return call, call * calls
