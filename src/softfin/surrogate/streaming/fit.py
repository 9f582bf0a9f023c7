"""Fits a streaming surrogate: first the profile, then the drive networks, the force networks and
the error estimates.

All members are trained together. Force networks are trained and scored on the motion that the drive
networks predict for complete logs, because a surrogate predicts forces from commands alone.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt, model_validator

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.compilation import chain_in_threads, jit
from softfin.core.errors import LogError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress
from softfin.core.quantities import Log, Reading, command_limits
from softfin.core.randomness import named_key
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.protocol import SurrogateConfig
from softfin.surrogate.streaming.ensemble import (
    Member,
    calibrated,
    ensemble,
    familiar,
    motions,
    predict_force,
    predict_motion,
    single,
)
from softfin.surrogate.streaming.nets import DriveNetConfig, FollowingNet, ForceNet, ForceNetConfig
from softfin.surrogate.streaming.profile import identify
from softfin.surrogate.streaming.segment_forces import segment_forces
from softfin.surrogate.streaming.segments import (
    Motion,
    Scales,
    SegmentBatch,
    Table,
    measure_scales,
    slices,
)
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.streaming.torque import fit_torque, with_torque
from softfin.surrogate.training import UPDATES_A_CALL, TrainingState, hold_out, keep_best_nets

WARM_UP = 100
"""Maximum number of updates during which the learning rate rises to its peak."""

MAX_SCORINGS = 10
"""Maximum number of times a network is scored on the held-out logs during training."""

NetLoss = Callable[
    [Any, SegmentBatch, Motion, Float[Array, ""], PRNGKeyArray, Any], Float[Array, ""]
]
"""Loss function of one member; its arguments are (net, segments, predicted motion, completed
fraction of training, key, config)."""


class StreamingConfig(SurrogateConfig):
    """Configuration for fitting a streaming ensemble; docs/appendix/surrogates.md contains the
    measurements on which the defaults are based."""

    model: ClassVar[str] = StreamingSurrogate.model

    drive: DriveNetConfig = DriveNetConfig()
    """Network from commands to motion."""
    force: ForceNetConfig = ForceNetConfig()
    """Network from motion to force."""
    members: PositiveInt = 5
    """Number of ensemble members. Each starts from different weights and is trained on different
    segments."""
    drive_updates: PositiveInt = 400
    """Number of updates of the drive networks, during which the learning rate decays to a hundredth
    of its peak (cosine)."""
    force_updates: PositiveInt = 2000
    """Number of updates of the force networks, with the same schedule."""
    batch: PositiveInt = 16
    """Number of log segments per update and member."""
    ticks: int = Field(default=250, ge=2)
    """Length of a segment [10 ms]; gradients are propagated through all of it."""
    burn_in: int = Field(default=80, ge=0)
    """Number of ticks at the start of a segment that are excluded from the loss, because the motion
    before the segment is unknown."""
    learning_rate: float = Field(default=0.01, gt=0)
    """Peak learning rate of Adam."""
    free_running: tuple[float, float] = (0.2, 0.8)
    """Start and end of the transition from measured to predicted motion as input to the force
    networks, as fractions of the training."""

    @model_validator(mode="after")
    def _in_order(self) -> "StreamingConfig":
        if self.burn_in >= self.ticks:
            raise ValueError(f"burn_in must be less than ticks = {self.ticks}")
        if not 0 <= self.free_running[0] <= self.free_running[1] <= 1:
            raise ValueError(
                "free_running must be two fractions from 0 to 1 in ascending order, e.g. 0.2, 0.8"
            )
        return self


class _MemberState(NamedTuple):
    number: int
    motion: Motion
    """Motion predicted by the drive network of the member."""
    nets: PyTree
    optimiser: PyTree
    loss: np.floating
    """Mean loss of the last call."""


class StreamingLearner:
    """Training step of one kind of network, compiled once and run for all members in threads."""

    def __init__(self, loss: NetLoss, config: StreamingConfig, updates: int) -> None:
        self.loss = loss
        self.config = config
        self.updates = updates
        rate = config.learning_rate
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, rate, min(WARM_UP, updates // 4), updates, rate / 100
        )
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self._program = jit("low")(self._run)

    def start(self, nets: PyTree) -> TrainingState:
        """Return the state before the first update."""
        worst = np.full(self.config.members, np.inf, np.float32)
        return TrainingState(nets, jax.jit(jax.vmap(self.optimiser.init))(nets), nets, worst)

    def run(
        self,
        state: TrainingState,
        table: Table,
        predicted: Motion,
        calls: Sequence[tuple[int, int]],
        key: PRNGKeyArray,
    ) -> Iterator[tuple[TrainingState, Float[np.ndarray, "members"]]]:
        """Yield the state and the mean loss of each member after each call.

        A call consists of the index of its first update and the number of updates.
        """
        # One program for all members would be slower, because XLA is slow at batches of small
        # matrix products on a CPU.
        arrays = jax.tree.map(np.asarray, (state.nets, state.optimiser, predicted))
        starts = []
        for number in range(self.config.members):
            nets, optimiser, motion = single(arrays, number)
            starts.append(_MemberState(number, motion, nets, optimiser, np.float32(0)))

        def run_member(member: _MemberState, call: tuple[int, int]) -> _MemberState:
            first, count = call
            trained = self._program(
                member.nets,
                member.optimiser,
                table,
                member.motion,
                jnp.int32(member.number),
                jnp.int32(first),
                count,
                key,
            )
            nets, optimiser, loss = jax.tree.map(np.asarray, trained)
            return member._replace(nets=nets, optimiser=optimiser, loss=loss)

        for members in chain_in_threads(run_member, starts, calls):
            trained = [(member.nets, member.optimiser, member.loss) for member in members]
            nets, optimiser, loss = jax.tree.map(lambda *x: np.stack(x), *trained)
            yield state._replace(nets=nets, optimiser=optimiser), loss

    def _run(
        self,
        net: PyTree,
        optimiser: PyTree,
        table: Table,
        predicted: Motion,
        member: Int[Array, ""],
        first: Int[Array, ""],
        count: int,
        key: PRNGKeyArray,
    ) -> tuple[PyTree, PyTree, Float[Array, ""]]:
        """Run the updates of one member; `count` is static."""

        def update(carry: PyTree, number: Int[Array, ""]) -> Any:
            net, optimiser = carry
            # Keys depend only on the update number, so resumed and uninterrupted runs are equal.
            keys = jax.random.split(jax.random.fold_in(key, number), self.config.members)
            draw, loss_key = jax.random.split(keys[member])
            segments = table.draw(draw, self.config.batch, self.config.ticks)
            motion = slices(predicted, segments.starts, self.config.ticks + 1)
            loss, slope = jax.value_and_grad(self.loss)(
                net, segments, motion, number / self.updates, loss_key, self.config
            )
            step, optimiser = self.optimiser.update(slope, optimiser, net)
            return (optax.apply_updates(net, step), optimiser), loss

        (net, optimiser), losses = jax.lax.scan(update, (net, optimiser), first + jnp.arange(count))
        return net, optimiser, losses.mean()


def motion_error(predicted: Motion, measured: Motion | Reading, scales: Scales) -> Any:
    """Return the sum of the squared angle and velocity errors, each divided by its scale."""
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
    """Return the mean of `motion_error` in a free run from the first tick of each segment."""
    before = jax.tree.map(lambda x: x[:, 0], segments.motion)
    predicted = jax.vmap(partial(motions, net))(before, segments.waiting, segments.commands)
    # Row 0 is the given motion, not a prediction.
    return jnp.mean(motion_error(predicted, segments.motion, net.scales)[:, 1 + config.burn_in :])


def force_loss(
    net: ForceNet,
    segments: SegmentBatch,
    predicted: Motion,
    done: Array,
    key: PRNGKeyArray,
    config: StreamingConfig,
) -> Float[Array, ""]:
    """Return the mean squared error of the scaled force, summed over both axes.

    The input is the measured motion of a segment or the motion predicted by the drive network. The
    probability of using the predicted motion rises from 0 to 1 over the `free_running` part of the
    training.
    """
    # Scheduled sampling: at the end of training, the input is the predicted motion, as during use.
    begin, end = config.free_running
    share = jnp.clip((done - begin) / jnp.maximum(end - begin, 1e-6), 0.0, 1.0)
    free = jax.random.bernoulli(key, share, (config.batch, 1))
    motion = jax.tree.map(lambda new, old: jnp.where(free, new, old), predicted, segments.motion)
    error = (segment_forces(net, motion) - segments.force) / net.scales.force_n
    return jnp.mean(jnp.sum(error**2, axis=-1)[:, config.burn_in :])


def fit_streaming(
    logs: Sequence[Log],
    config: StreamingConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
    members: Member | None = None,
) -> StreamingSurrogate:
    """Fit an ensemble to the training logs; resume from the checkpoint in `run_directory` if there
    is one.

    Training starts from `members`, or by default from random weights.
    """
    training, holding, scales, table = split_streaming(logs, config)
    key = named_key(seed, "fit/weights")
    start = jit("none")(ensemble)
    members = members or start(config.members, config.drive, config.force, scales, key)
    learners = {
        "drive": StreamingLearner(drive_loss, config, config.drive_updates),
        "force": StreamingLearner(force_loss, config, config.force_updates),
    }
    num_updates = config.drive_updates + config.force_updates
    states = {
        "drive": learners["drive"].start(members.drive),
        "force": learners["force"].start(members.force),
    }
    done: JsonObject = dict.fromkeys(learners, 0)
    if (resumed := run_directory.load(states)) is not None:
        states, done = resumed
    else:
        if progress is not None:
            progress("fit", 0.0, "identifying the drive profile from the logs")
        identified, _ = identify(training, seed)
        # All members share the profile.
        profile = jax.tree.map(lambda x: jnp.full((config.members, *x.shape), x), identified)
        nets = eqx.tree_at(lambda nets: nets.profile, states["drive"].nets, profile)
        states["drive"] = states["drive"]._replace(nets=nets, best=nets)
    record = run_directory.log(rewind_to=sum(done.values()))

    def learn(name: str, predicted: Motion, errors: Callable[[PyTree], list[np.ndarray]]) -> Any:
        """Run all updates of one kind of network and return the best weights of each member.

        `errors` returns the squared errors on each held-out log, ``(members, rows)``.
        """
        key = named_key(seed, f"fit/{name}")
        updates = learners[name].updates
        call, round_of = _calls(updates)
        before = config.drive_updates if name == "force" else 0
        text = f"{name} networks"
        while done[name] < updates:
            state = states[name]
            losses = []
            until = min(done[name] + round_of, updates)
            calls = [(first, min(call, until - first)) for first in range(done[name], until, call)]
            after_calls = learners[name].run(state, table, predicted, calls, key)
            for (first, count), (after, loss) in zip(calls, after_calls, strict=True):
                state = after
                losses.append(loss)
                if progress is not None:
                    progress("fit", (before + first + count) / num_updates, text)
            # A diverged network overflows here; keep_best_nets then raises an error.
            with np.errstate(over="ignore", invalid="ignore"):
                held_out = np.mean([each.mean(axis=1) for each in errors(state.nets)], axis=0)
            states[name], _ = keep_best_nets(state, losses, held_out, f"{name} networks")
            done[name] = until
            # Sum over two channels: force (x, y), or scaled angle and velocity.
            error = float(np.sqrt(held_out.mean() / 2))
            unit = " N" if name == "force" else ""
            text = f"{name} networks, error {error:.2g}{unit} in held-out logs"
            means = {f"train/{name}_loss": loss.mean(), f"held_out/{name}_mse": held_out.mean()}
            record.write(before + until, **jax.tree.map(float, means))
            run_directory.save(states, done)
        return states[name].best

    def drive_errors(nets: FollowingNet) -> list[np.ndarray]:
        predictions = predict_motion(nets, holding)
        return [
            motion_error(predicted, log.reading, scales)
            for predicted, log in zip(predictions, holding, strict=True)
        ]

    def force_errors(nets: ForceNet) -> list[np.ndarray]:
        errors = []
        for force, log in zip(predict_force(nets, held_motion), holding, strict=True):
            error = (force - log.reading.force)[:, burn_in:]
            errors.append((error**2).sum(axis=-1))
        return errors

    # The drive loss ignores the predicted motion, but both learners have the same arguments.
    nothing = jnp.zeros((config.members, table.force.shape[0]))
    not_used = Motion(nothing, nothing)
    drives = learn("drive", not_used, drive_errors)
    # Predictions for complete logs, concatenated like the rows of the table.
    motion = predict_motion(drives, training)
    joined = jax.tree.map(lambda *parts: jnp.asarray(np.concatenate(parts, axis=1)), *motion)
    held_motion = predict_motion(drives, holding)
    burn_in = config.burn_in
    force_nets = learn("force", joined, force_errors)
    interval = calibrated(predict_force(force_nets, held_motion), holding, burn_in)
    familiarity = familiar(force_nets, motion, burn_in)
    trained = with_torque(motion, training)
    held = with_torque(held_motion, holding)
    force_nets, power_interval = fit_torque(force_nets, trained, held, burn_in)
    return StreamingSurrogate(
        Member(drives, force_nets), command_limits(training), interval, familiarity, power_interval
    )


def split_streaming(
    logs: Sequence[Log], config: StreamingConfig
) -> tuple[Sequence[Log], list[Log], Scales, Table]:
    """Return the training logs, the held-out logs, and the scales and table of the training logs.

    Raises:
        LogError: If there are too few logs or rows, or a channel never changes.
    """
    training, held_out = hold_out(logs, config.held_out)
    needed = config.burn_in + PAPER_CLOCK.window_ticks
    holding = [log for log in held_out if log.rows >= needed]
    if not holding:
        raise LogError(
            f"held-out logs: none of {len(held_out)} has the {needed} rows that are required for "
            f"intervals of the mean over {PAPER_CLOCK.window_ticks} samples after burn_in = "
            f"{config.burn_in}; record longer logs"
        )
    return training, holding, measure_scales(training), Table.of(training, config.ticks)


def _calls(updates: int) -> tuple[int, int]:
    """Return the number of updates per call and between two scorings.

    All calls except the last have the same length, so that they share one compiled program.
    """
    # -(-a // b) is a / b rounded up.
    round_of = -(-updates // MAX_SCORINGS)
    calls = -(-round_of // UPDATES_A_CALL)
    call = -(-round_of // calls)
    return call, call * calls
