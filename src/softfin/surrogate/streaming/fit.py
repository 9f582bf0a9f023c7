"""Fits a streaming surrogate: profile, drive nets, force nets, then the estimates of their errors, in this order.

Force nets are trained on the motion that the drive nets predict for whole logs, so that both are scored as they will be
used: free-running, from the commands alone.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError
from softfin.core.quantities import Limits, Log
from softfin.core.randomness import key_of
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.channels import COMMANDS, joined_channels
from softfin.surrogate.streaming.drive import DriveNet
from softfin.surrogate.streaming.force import ForceNet, Motion
from softfin.surrogate.streaming.identify import identify
from softfin.surrogate.streaming.learner import Learner, StreamingConfig, drive_loss, force_loss
from softfin.surrogate.streaming.member import Member, ensemble, predict_force, predict_logs, predict_motion
from softfin.surrogate.streaming.profile import LONGEST_DELAY, Profile, ProfileConfig
from softfin.surrogate.streaming.segments import Table, scales_of
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.streaming.uncertainty import calibrated, familiar
from softfin.surrogate.training import (
    UPDATES_A_CALL,
    Call,
    Progress,
    TrainingState,
    check_lengths,
    held_out_count,
    train,
)

ROUNDS = 10
"""Times that a net is scored on the held-out logs while it is trained."""


class _Both(NamedTuple):
    """What a checkpoint holds."""

    drive: TrainingState
    force: TrainingState


def fit_streaming(
    logs: Sequence[Log],
    config: StreamingConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> StreamingSurrogate:
    """Fit an ensemble to the training logs; goes on from the run_directory's checkpoint where there is one.

    Raises:
        LogError: too few logs, logs too short for a segment, or logs in which nothing moves.
        RunError: the loss is no longer finite.
    """
    return StreamingFit(logs, config, seed, run_directory, progress).run()


class StreamingFit:
    """One fit and what its parts share; to make one raises LogError where the logs cannot be fitted."""

    def __init__(
        self,
        logs: Sequence[Log],
        config: StreamingConfig,
        seed: int,
        run_directory: RunDirectory,
        progress: Progress | None,
    ) -> None:
        held_out = held_out_count(len(logs), config.held_out)
        self.training, self.holding = list(logs[:-held_out]), list(logs[-held_out:])
        check_lengths(self.holding, config.burn_in, "held-out")
        longest = max(len(log.reading.time) for log in self.holding)
        if longest < config.burn_in + WINDOW:
            raise LogError(
                f"the longest of {held_out} held-out logs has {longest} rows; intervals on the mean over {WINDOW} "
                f"samples behind burn_in = {config.burn_in} need {config.burn_in + WINDOW}; record longer"
            )
        self.config, self.seed, self.run_directory, self.progress = config, seed, run_directory, progress
        self.scales = scales_of(self.training)
        self.table = Table.of(self.training, config.ticks)
        self.updates = {"drive": config.drive_updates, "force": config.force_updates}

    def run(self) -> StreamingSurrogate:
        """Fit the whole ensemble."""
        config = self.config
        parts = (config.drive, config.force, ProfileConfig(), self.scales)
        members = ensemble(config.members, *parts, key_of(self.seed, "fit/weights"))
        drive = Learner(drive_loss(config), config, config.drive_updates)
        force = Learner(force_loss(config), config, config.force_updates)
        both = _Both(drive.start(members.drive), force.start(members.force))
        done: dict[str, Any] = {"drive": 0, "force": 0}
        if (resumed := self.run_directory.load(both)) is not None:
            both, done = resumed
        elif config.drive.profile:
            both = both._replace(drive=self._with_profile(both.drive))
        self.record = self.run_directory.log(rewind_to=sum(done[name] for name in self.updates))
        if resumed is None:
            short = sum(len(log.reading.time) <= LONGEST_DELAY + config.ticks for log in self.training)
            self.record.write(0, logs=float(len(self.training)), logs_shorter_than_a_segment=float(short))
        not_used = Motion(*(jnp.zeros((config.members, self.table.force.shape[0])) for _ in range(2)))
        for state in self._train("drive", drive, both.drive, done, not_used, self._drive_error):
            both = both._replace(drive=state)
            self.run_directory.save(both, done)
        drives = both.drive.best
        predicted = predict_motion(drives, self.training)
        joined = Motion(*(jnp.asarray(np.concatenate(parts, axis=1)) for parts in zip(*predicted, strict=True)))
        held_out = predict_motion(drives, self.holding)
        force_error = partial(self._force_error, held_out)
        for state in self._train("force", force, both.force, done, joined, force_error):
            both = both._replace(force=state)
            self.run_directory.save(both, done)
        self.record.close()
        return self._finished(Member(drives, both.force.best))

    def _with_profile(self, state: TrainingState) -> TrainingState:
        """Put the coefficients of the drive's profile into every member."""
        if self.progress is not None:
            self.progress("fit", 0.0, "identifying the drive's profile from the logs")
        found, _ = identify(self.training, self.seed)
        profile = jax.tree.map(lambda x: jnp.full((self.config.members, *x.shape), x), Profile(found))
        nets = eqx.tree_at(lambda nets: nets.profile, state.nets, profile)
        return state._replace(nets=nets, best=nets)

    def _train(
        self,
        name: str,
        learner: Learner,
        state: TrainingState,
        done: dict[str, Any],
        predicted: Motion,
        held_out_loss: Callable[[Any], Float[np.ndarray, "members"]],
    ) -> Iterator[TrainingState]:
        """The updates of one kind of net, in rounds; yields the state after each."""
        key, updates = key_of(self.seed, f"fit/{name}"), self.updates[name]
        call, round_of = _calls(updates)
        before = self.updates["drive"] if name == "force" else 0

        def run(state: TrainingState, first: int, count: int) -> tuple[TrainingState, Float[Array, "members"]]:
            state, loss = learner.run(state, self.table, predicted, jnp.int32(first), count, key)
            if self.progress is not None:
                part = (before + first + count) / sum(self.updates.values())
                self.progress("fit", part, f"{name} nets, loss {float(loss.mean()):.3g}")
            return state, loss

        def rounds() -> Iterator[list[Call]]:
            for first in range(done[name], updates, round_of):
                until = min(first + round_of, updates)
                yield [partial(run, first=at, count=min(call, until - at)) for at in range(first, until, call)]

        for each in train(state, rounds(), held_out_loss, f"{name} nets"):
            done[name] = min(done[name] + round_of, updates)
            means = {f"train/{name}_loss": each.losses[-1], f"held_out/{name}_mse": each.held_out}
            self.record.write(before + done[name], **{title: float(x.mean()) for title, x in means.items()})
            yield each.state

    def _drive_error(self, nets: DriveNet) -> Float[np.ndarray, "members"]:
        """Mean square error of angle and velocity over the held-out logs, each in its own unit."""
        parts = []
        for predicted, log in zip(predict_motion(nets, self.holding), self.holding, strict=True):
            angle = (predicted.angle - log.reading.angle) / self.scales.angle_rad
            velocity = (predicted.velocity - log.reading.velocity) / self.scales.velocity_rad_s
            parts.append((angle**2 + velocity**2).mean(axis=1))
        return np.asarray(np.mean(parts, axis=0))

    def _force_error(self, motion: Sequence[Motion], nets: ForceNet) -> Float[np.ndarray, "members"]:
        """Mean square error of the force over the held-out logs, behind the drive nets [N2]."""
        each = zip(predict_force(nets, motion), self.holding, strict=True)
        errors = [(force - log.reading.force)[:, self.config.burn_in :] for force, log in each]
        return np.asarray(np.mean([(error**2).sum(-1).mean(axis=1) for error in errors], axis=0))

    def _finished(self, members: Member) -> StreamingSurrogate:
        columns = joined_channels(self.training)
        limits = Limits(*(float(end) for name in COMMANDS for end in (columns[name].min(), columns[name].max())))
        held_out = [predicted.force for predicted in predict_logs(members, self.holding)]
        interval = calibrated(held_out, self.holding, self.config.burn_in)
        return StreamingSurrogate(members, limits, interval, familiar(members, self.training, self.config.burn_in))


def _calls(updates: int) -> tuple[int, int]:
    """Updates a call and a round: rounds of equal calls, so that one compiled program does all but the very last."""
    round_of = -(-updates // ROUNDS)
    calls = -(-round_of // UPDATES_A_CALL)
    call = -(-round_of // calls)
    return call, call * calls
