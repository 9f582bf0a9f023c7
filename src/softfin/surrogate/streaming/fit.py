"""Fitting a streaming surrogate: profile, drive nets, force nets, then what is known of their errors, in this order.

The force nets are fed with what the trained drive nets say of whole logs, so that both are judged as they will be used:
free-running, from the commands alone.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError, RunError
from softfin.core.quantities import Limits, Log
from softfin.core.randomness import key_of
from softfin.storage.run_directory import Workspace
from softfin.surrogate.paper.fit import Progress, check_lengths, held_out
from softfin.surrogate.paper.posnet import COMMANDS
from softfin.surrogate.paper.predict import channels_of
from softfin.surrogate.streaming.config import StreamingConfig
from softfin.surrogate.streaming.drive import DriveNet, FollowingNet
from softfin.surrogate.streaming.follow import follow, follow_force, follow_motion
from softfin.surrogate.streaming.force import ForceNet, Motion
from softfin.surrogate.streaming.identify import identify
from softfin.surrogate.streaming.learner import UPDATES_A_CALL, Learner, Learning, drive_loss, force_loss, keep_best
from softfin.surrogate.streaming.member import Member, ensemble
from softfin.surrogate.streaming.profile import LONGEST_DELAY, Profile, ProfileConfig
from softfin.surrogate.streaming.sequences import Table, scales_of
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.streaming.uncertainty import calibrated, familiar

ROUNDS = 10
"""Times that a net is scored on the held-out logs while it is trained."""


class _Both(NamedTuple):
    """What a checkpoint holds."""

    drive: Learning
    force: Learning


def fit_streaming(
    logs: Sequence[Log], config: StreamingConfig, seed: int, workspace: Workspace, progress: Progress | None = None
) -> StreamingSurrogate:
    """Fit an ensemble to the training logs; goes on from the workspace's checkpoint where there is one.

    Raises:
        LogError: too few logs, logs too short for a stretch, or logs in which nothing moves.
        RunError: the loss is no longer finite.
    """
    return _Fit(logs, config, seed, workspace, progress).run()


def check_streaming(logs: Sequence[Log], config: StreamingConfig, workspace: Workspace) -> None:
    """Raise LogError where `fit_streaming` would before it begins."""
    _Fit(logs, config, 0, workspace, None)


class _Fit:
    """One fit and what its parts share."""

    def __init__(
        self, logs: Sequence[Log], config: StreamingConfig, seed: int, workspace: Workspace, progress: Progress | None
    ) -> None:
        held = held_out(len(logs), config.held_out)
        self.training, self.holding = list(logs[:-held]), list(logs[-held:])
        check_lengths(self.holding, config.burn_in, "held-out")
        longest = max(len(log.reading.time) for log in self.holding)
        if longest < config.burn_in + WINDOW:
            raise LogError(
                f"the longest of {held} held-out logs has {longest} rows; intervals on the mean over {WINDOW} samples "
                f"behind burn_in = {config.burn_in} need {config.burn_in + WINDOW}; record longer"
            )
        self.config, self.seed, self.workspace, self.progress = config, seed, workspace, progress
        self.scales = scales_of(self.training)
        self.table = Table.of(self.training, config.ticks)
        self.updates = {"drive": config.drive_updates, "force": config.force_updates}

    def run(self) -> StreamingSurrogate:
        """All of it."""
        config = self.config
        parts = (config.drive, config.force, ProfileConfig(), self.scales)
        members = ensemble(config.members, *parts, key_of(self.seed, "fit/weights"))
        drive = Learner(drive_loss(config), config, config.drive_updates)
        force = Learner(force_loss(config), config, config.force_updates)
        learning = _Both(drive.start(members.drive), force.start(members.force))
        done: dict[str, Any] = {"drive": 0, "force": 0}
        if (resumed := self.workspace.load(learning)) is not None:
            learning, done = resumed
        elif config.drive.profile:
            learning = learning._replace(drive=self._with_profile(learning.drive))
        self.record = self.workspace.log(rewind_to=sum(done[name] for name in self.updates))
        if resumed is None:
            short = sum(len(log.reading.time) <= LONGEST_DELAY + config.ticks for log in self.training)
            self.record.write(0, logs=float(len(self.training)), logs_shorter_than_a_stretch=float(short))
        nowhere = Motion(*(jnp.zeros((config.members, self.table.force.shape[0])) for _ in range(2)))
        for state in self._train("drive", drive, learning.drive, done, nowhere, self._drive_error):
            learning = learning._replace(drive=state)
            self.workspace.save(learning, done)
        drives = learning.drive.best
        foretold = _end_to_end(follow_motion(drives, self.training))
        self.heard = follow_motion(drives, self.holding)
        for state in self._train("force", force, learning.force, done, foretold, self._force_error):
            learning = learning._replace(force=state)
            self.workspace.save(learning, done)
        self.record.close()
        return self._finished(Member(drives, learning.force.best))

    def _with_profile(self, learning: Learning) -> Learning:
        """The coefficients of the drive's profile in every member."""
        if self.progress is not None:
            self.progress("fit", 0.0, "reading the drive's profile off the logs")
        found, _ = identify(self.training, self.seed)
        count = self.config.members
        profile = jax.tree.map(lambda x: jnp.full((count, *x.shape), x), Profile(found))

        def with_it(nets: FollowingNet) -> FollowingNet:
            changed: FollowingNet = eqx.tree_at(lambda nets: nets.profile, nets, profile)
            return changed

        return learning._replace(nets=with_it(learning.nets), best=with_it(learning.best))

    def _train(
        self,
        name: str,
        learner: Learner,
        state: Learning,
        done: dict[str, Any],
        foretold: Motion,
        error: Callable[[Any], Float[np.ndarray, "members"]],
    ) -> Iterator[Learning]:
        """The updates of one kind of net, in rounds; yields the state after each."""
        key = key_of(self.seed, f"fit/{name}")
        updates = self.updates[name]
        call, round_of = _calls(updates)
        before = sum(self.updates[other] for other in list(self.updates)[: list(self.updates).index(name)])
        while done[name] < updates:
            until = min(done[name] + round_of, updates)
            while done[name] < until:
                count = min(call, until - done[name])
                state, loss = learner.run(state, self.table, foretold, jnp.int32(done[name]), count, key)
                done[name] += count
                if self.progress is not None:
                    part = (before + done[name]) / sum(self.updates.values())
                    self.progress("fit", part, f"{name} nets, loss {float(loss.mean()):.3g}")
            # Told in words below.
            with np.errstate(over="ignore", invalid="ignore"):
                errors = error(state.nets)
            if not np.isfinite([*np.asarray(loss), *errors]).all():
                raise RunError(f"fit: the {name} nets' loss is not finite; lower learning_rate (--set), start anew")
            state = keep_best(state, jnp.asarray(errors, jnp.float32))
            scalars = {f"train/{name}_loss": float(loss.mean()), f"held_out/{name}_mse": float(errors.mean())}
            self.record.write(before + done[name], **scalars)
            yield state

    def _drive_error(self, nets: DriveNet) -> Float[np.ndarray, "members"]:
        """Mean square error of angle and velocity over the held-out logs, each in its own unit."""
        parts = []
        for said, log in zip(follow_motion(nets, self.holding), self.holding, strict=True):
            angle = (said.angle - log.reading.angle) / self.scales.angle_rad
            velocity = (said.velocity - log.reading.velocity) / self.scales.velocity_rad_s
            parts.append((angle**2 + velocity**2).mean(axis=1))
        return np.asarray(np.mean(parts, axis=0))

    def _force_error(self, nets: ForceNet) -> Float[np.ndarray, "members"]:
        """Mean square error of the force over the held-out logs, behind the drive nets [N2]."""
        skipped = self.config.burn_in
        each = zip(follow_force(nets, self.heard), self.holding, strict=True)
        parts = [((said.force - log.reading.force)[:, skipped:] ** 2).sum(-1).mean(axis=1) for said, log in each]
        return np.asarray(np.mean(parts, axis=0))

    def _finished(self, members: Member) -> StreamingSurrogate:
        columns = [channels_of(log) for log in self.training]
        ranges = [(min(c[name].min() for c in columns), max(c[name].max() for c in columns)) for name in COMMANDS]
        limits = Limits(*(float(value) for pair in ranges for value in pair))
        held = follow(members, self.holding)
        return StreamingSurrogate(
            members,
            limits,
            calibrated([said.force for said in held], self.holding, self.config),
            familiar(members, self.training, self.config.burn_in),
        )


def _calls(updates: int) -> tuple[int, int]:
    """Updates a call and a round: rounds of equal calls, so that one compiled program does all but the very last."""
    round_of = -(-updates // ROUNDS)
    calls = -(-round_of // UPDATES_A_CALL)
    call = -(-round_of // calls)
    return call, call * calls


def _end_to_end(motion: Sequence[Motion]) -> Motion:
    """As the rows of the table are."""

    def joined(parts: list[Any]) -> Array:
        return jnp.asarray(np.concatenate(parts, axis=1))

    return Motion(joined([m.angle for m in motion]), joined([m.velocity for m in motion]))
