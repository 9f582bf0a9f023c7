"""An ensemble of streaming nets as a Plant: commands in, readings out at 100 Hz, with what is known of their errors."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.errors import ArtifactError, LogError
from softfin.core.plant import rest_command
from softfin.core.quantities import TICK_S, Command, Limits, Log, Reading
from softfin.core.ticks import tick_at
from softfin.surrogate.streaming.force import Motion, Said
from softfin.surrogate.streaming.member import Member, MemberState, parameters, single
from softfin.surrogate.streaming.profile import LONGEST_DELAY
from softfin.surrogate.streaming.uncertainty import Familiarity, Interval, remembered

MEMORY = 300
"""Ticks of a recorded history that `warm` follows: a stroke at the paper's least velocity takes as long."""

SETTLED = 3000
"""Ticks that `init` has been at rest for: twenty of the longest time constants that a wake begins with."""


class StreamingState(NamedTuple):
    """Of every member; it does not grow, whatever it remembers."""

    tick: Int[Array, ""]
    """Since the start [10 ms]."""
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
        after, (motion, predicted) = jax.lax.scan(
            lambda each, _: self.net.step(each, held), state.members, length=ticks
        )
        time = (state.tick + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        reading = Reading(time, motion.angle, motion.velocity, predicted.force)
        return StreamingState(state.tick + ticks, after), reading


class StreamingSurrogate(eqx.Module):
    """A learnt fin; meets the Plant contract. Readings are the mean over the members."""

    members: Member
    """Stacked."""
    rest: MemberState
    """Long at rest at angle 0; stacked."""
    familiarity: Familiarity
    interval: Interval = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """The range of the commands in the training data: beyond it the nets extrapolate."""

    model: ClassVar[str] = "streaming"
    """Among the kinds of surrogates."""
    memory: ClassVar[int] = MEMORY
    """Rows of a log that `warm` needs."""

    def __init__(self, members: Member, limits: Limits, interval: Interval, familiarity: Familiarity) -> None:
        self.members, self.limits, self.interval, self.familiarity = members, limits, interval, familiarity
        command = rest_command(limits)
        waiting = Command(*(jnp.full(LONGEST_DELAY, value) for value in command))
        still = Motion(jnp.zeros(()), jnp.zeros(()))

        self.rest = _after(members, still, waiting, Command(*(jnp.full(SETTLED, value) for value in command)))

    @property
    def size(self) -> int:
        """How many members."""
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
        """The same with every member's own reading: fields ``(members, ticks)``."""
        state, (motion, said) = self._held(state, command, ticks)
        time = (state.tick - ticks + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        reading = Reading(jnp.tile(time, (self.size, 1)), motion.angle, motion.velocity, said.force)
        return state, reading

    def member(self, index: Int[Array, ""]) -> "StreamingMember":
        """One member as a plant of its own; `index` may be a value in a program."""
        return StreamingMember(*jax.tree.map(lambda leaf: leaf[index], (self.members, self.rest)), self.limits)

    def deviation(self, state: StreamingState, command: Command, ticks: int) -> Float[Array, "ticks"]:
        """Standard deviation of each axis' reading about the mean [N], as the nets learnt it while a command is held.

        Raises ArtifactError where they learnt none.
        """
        net = self.members.force
        if not net.config.heteroscedastic:
            raise ArtifactError("this surrogate learnt no deviations; fit it with --set force.heteroscedastic=true")
        _, (_, said) = self._held(state, command, ticks)
        return net.scales.force_n * jnp.sqrt(jnp.exp(2 * jnp.asarray(said.log_deviation)).mean(axis=0))

    def _held(self, state: StreamingState, command: Command, ticks: int) -> tuple[StreamingState, tuple[Motion, Said]]:
        """What every member says while a command is held: fields ``(members, ticks)``."""
        held = Command(*(jnp.asarray(part, jnp.float32) for part in command))

        def tick(each: MemberState, _: None) -> tuple[MemberState, tuple[Motion, Said]]:
            stepped: tuple[MemberState, tuple[Motion, Said]]
            stepped = jax.vmap(lambda member, state: member.step(state, held))(self.members, each)
            return stepped

        members, said = jax.lax.scan(tick, state.members, length=ticks)
        each: tuple[Motion, Said] = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), said)
        return StreamingState(state.tick + ticks, members), each

    def distance(self, state: StreamingState) -> Float[Array, ""]:
        """Of what the fin has been doing to the training data: 1 is as far as one in a thousand moments of them."""
        return self.familiarity.distance(remembered(single(state.members.force)))

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin, all members together."""
        return 2 * single(self.members).products() * self.size

    def parameters(self) -> int:
        """Of all members."""
        return parameters(self.members)


@eqx.filter_jit
def _after(members: Member, motion: Motion, waiting: Command, passed: Command) -> MemberState:
    """What every member remembers when these commands have passed, one a tick."""

    def one(member: Member) -> MemberState:
        def step(state: MemberState, command: Any) -> tuple[MemberState, None]:
            return member.step(state, Command(*command))[0], None

        return jax.lax.scan(step, member.start(motion, waiting), passed)[0]

    state: MemberState = eqx.filter_vmap(one)(members)
    return state
