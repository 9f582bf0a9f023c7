"""An ensemble of streaming nets as a Plant: commands in, readings out at 100 Hz, with estimates of their errors."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.errors import ArtifactError, LogError
from softfin.core.plant import rest_command
from softfin.core.quantities import TICK_S, Command, Limits, Log, Reading, tick_at
from softfin.surrogate.channels import ANGLE, COMMANDS, FORCES, READINGS, SKIPPED, NetPrediction
from softfin.surrogate.streaming.core import products
from softfin.surrogate.streaming.drive import LONGEST_DELAY, DriveNetConfig
from softfin.surrogate.streaming.force import ForceNetConfig, Motion, Scales
from softfin.surrogate.streaming.member import (
    Member,
    MemberState,
    ensemble,
    parameters,
    predict_force,
    predict_logs,
    single,
)
from softfin.surrogate.streaming.uncertainty import Familiarity, Interval, remembered

MEMORY = 300
"""Ticks of a recorded history that `warm` follows: a stroke at the paper's least velocity takes as long."""

SETTLED = 3000
"""Ticks that `init` has been at rest for: twenty of the longest time constants that a wake begins with."""

CHANNELS = {"in": list(COMMANDS), "out": list(READINGS)}


class StreamingState(NamedTuple):
    """State of every member; it does not grow, whatever it remembers."""

    tick: Int[Array, ""]
    """Ticks since the start [10 ms]."""
    members: MemberState


class StreamingMember(eqx.Module):
    """One member of an ensemble as a plant of its own; meets the Plant contract."""

    net: Member
    rest: MemberState
    """State long at rest at angle 0."""
    limits: Limits = eqx.field(static=True)

    def init(self, key: PRNGKeyArray) -> StreamingState:
        """Long at rest at angle 0. Nothing is random here: the key is not used."""
        return StreamingState(jnp.int32(0), self.rest)

    def advance(self, state: StreamingState, command: Command, ticks: int) -> tuple[StreamingState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and read after each: fields ``(ticks,)``."""
        held = Command(*(jnp.asarray(part, jnp.float32) for part in command))
        after, (motion, force) = jax.lax.scan(lambda each, _: self.net.step(each, held), state.members, length=ticks)
        time = (state.tick + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        return StreamingState(state.tick + ticks, after), Reading(time, motion.angle, motion.velocity, force)


class StreamingSurrogate(eqx.Module):
    """An ensemble; meets the contract of EnsemblePlant. Readings are the members' mean."""

    members: Member
    """Members, stacked."""
    rest: MemberState
    """Their states long at rest at angle 0, stacked."""
    familiarity: Familiarity
    interval: Interval = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """The range of the commands in the training data: beyond it the nets extrapolate."""

    model: ClassVar[str] = "streaming"
    memory: ClassVar[int] = MEMORY
    """Rows of a log that `warm` needs."""
    scaling: ClassVar[None] = None

    def __init__(self, members: Member, limits: Limits, interval: Interval, familiarity: Familiarity) -> None:
        self.members, self.limits, self.interval, self.familiarity = members, limits, interval, familiarity
        command = rest_command(limits)
        waiting, passed = (Command(*(jnp.full(n, value) for value in command)) for n in (LONGEST_DELAY, SETTLED))
        self.rest = _after(members, Motion(jnp.zeros(()), jnp.zeros(())), waiting, passed)

    @property
    def size(self) -> int:
        """Number of members."""
        return int(self.members.force.offset.shape[0])

    def init(self, key: PRNGKeyArray) -> StreamingState:
        """Long at rest at angle 0. Nothing is random here: the key is not used."""
        return StreamingState(jnp.int32(0), self.rest)

    def warm(self, history: Log) -> StreamingState:
        """The state after a recorded history, free-running over its last `memory` rows; raises LogError if shorter."""
        rows = len(history.reading.time)
        if rows < self.memory:
            raise LogError(f"history: {rows} rows; {self.memory} are needed to know what the fin has been doing")
        command = Command(*(np.asarray(part[-self.memory :], np.float32) for part in history.command))
        first = self.memory - LONGEST_DELAY
        motion = Motion(*(jnp.float32(part[-first]) for part in (history.reading.angle, history.reading.velocity)))
        waiting = Command(*(jnp.asarray(part[:LONGEST_DELAY][::-1]) for part in command))
        # The last row's command shows in the row that comes next.
        passed = Command(*(jnp.asarray(part[LONGEST_DELAY:-1]) for part in command))
        tick = tick_at(float(history.reading.time[-1]))
        return StreamingState(jnp.int32(tick), _after(self.members, motion, waiting, passed))

    def advance(self, state: StreamingState, command: Command, ticks: int) -> tuple[StreamingState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and read after each: fields ``(ticks,)``."""
        state, each = self.advance_members(state, command, ticks)
        return state, each._replace(
            time=each.time[0], angle=each.angle.mean(0), velocity=each.velocity.mean(0), force=each.force.mean(0)
        )

    def advance_members(self, state: StreamingState, command: Command, ticks: int) -> tuple[StreamingState, Reading]:
        """As `advance`, with every member's own reading: fields ``(members, ticks)``."""

        def one(net: Member, rest: MemberState, own: MemberState) -> tuple[MemberState, Reading]:
            member = StreamingMember(net, rest, self.limits)
            after, reading = member.advance(StreamingState(state.tick, own), command, ticks)
            return after.members, reading

        members, reading = jax.vmap(one)(self.members, self.rest, state.members)
        return StreamingState(state.tick + ticks, members), reading

    def member(self, index: Int[Array, ""]) -> "StreamingMember":
        """One member as a plant of its own; `index` may be a value in a program."""
        net, rest = jax.tree.map(lambda leaf: leaf[index], (self.members, self.rest))
        return StreamingMember(net, rest, self.limits)

    def distance(self, state: StreamingState) -> Float[Array, ""]:
        """Distance of the last motion from the training data: 1 is as far as one in a thousand moments of them."""
        return self.familiarity.distance(remembered(single(state.members.force)))

    def predictions(self, logs: Sequence[Log]) -> list[dict[str, NetPrediction]]:
        """Mean predictions of every log by the drive nets, and by the force nets given the motion and behind those."""
        nets = self.members
        drive, force = ((None, parameters(net)) for net in (nets.drive, nets.force))
        measured = [Motion(*np.tile(np.stack([r.angle, r.velocity])[:, None], (self.size, 1))) for _, r in logs]
        return [
            {
                "drive": NetPrediction((ANGLE,), np.mean(free.motion.angle, axis=0)[SKIPPED:, None], *drive),
                "force_measured": NetPrediction(FORCES, given.mean(axis=0)[SKIPPED:], *force),
                "force_free_running": NetPrediction(FORCES, free.force.mean(axis=0)[SKIPPED:], *force),
            }
            for free, given in zip(predict_logs(nets, logs), predict_force(nets.force, measured), strict=True)
        ]

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin, all members together."""
        return 2 * products(single(self.members)) * self.size

    def parameters(self) -> int:
        """Trainable numbers of all members."""
        return parameters(self.members)

    def to_files(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Entries of ``surrogate.json``, and the arrays by their place in the nets."""
        drive, force = self.members.drive, self.members.force
        entries = {
            "channels": CHANNELS,
            "members": self.size,
            "networks": {"drive": drive.config.model_dump(mode="json"), "force": force.config.model_dump(mode="json")},
            "scales": force.scales.model_dump(mode="json"),
            "interval": self.interval.model_dump(mode="json"),
            "parameters": self.parameters(),
        }
        arrays = jax.tree_util.tree_leaves_with_path({"members": self.members, "familiarity": self.familiarity})
        return entries, {_name(path): np.asarray(leaf) for path, leaf in arrays}

    @classmethod
    def from_files(
        cls, description: dict[str, Any], weights: dict[str, np.ndarray], source: str
    ) -> "StreamingSurrogate":
        """The surrogate that `to_files` described; raises ArtifactError where channels or arrays do not fit."""
        if description["channels"] != CHANNELS:
            raise ArtifactError(f"{source}: channels {description['channels']}; streaming surrogates have {CHANNELS}")
        drive = DriveNetConfig.build(description["networks"]["drive"], f"{source}: networks.drive")
        force = ForceNetConfig.build(description["networks"]["force"], f"{source}: networks.force")
        scales = Scales.model_validate(description["scales"])

        def skeleton() -> dict[str, Any]:
            size = int(description["members"])
            members = ensemble(size, drive, force, scales, jax.random.key(0))
            memory = 2 * (force.units + force.wake)
            familiarity = Familiarity(jnp.zeros(memory), jnp.zeros((memory, memory)))
            return {"members": members, "familiarity": familiarity}

        def leaf(path: Any, shape: Any) -> Any:
            array = weights.get(_name(path))
            if array is None or array.shape != shape.shape:
                what = "is missing" if array is None else f"has the shape {array.shape}"
                raise ArtifactError(
                    f"{source}: {_name(path)} {what}, must have {shape.shape}; copy the whole folder again"
                )
            return jnp.asarray(array)

        trees = jax.tree_util.tree_map_with_path(leaf, eqx.filter_eval_shape(skeleton))
        limits = Limits.of(description["limits"], one_velocity=True)
        interval = Interval.model_validate(description["interval"])
        return cls(trees["members"], limits, interval, trees["familiarity"])


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


@eqx.filter_jit
def _after(members: Member, motion: Motion, waiting: Command, passed: Command) -> MemberState:
    """State of every member after these commands, one a tick."""

    def one(member: Member) -> MemberState:
        def step(state: MemberState, command: Any) -> tuple[MemberState, None]:
            return member.step(state, Command(*command))[0], None

        return jax.lax.scan(step, member.start(motion, waiting), passed)[0]

    state: MemberState = eqx.filter_vmap(one)(members)
    return state
