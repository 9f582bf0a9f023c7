"""Training over an ensemble: every fin is another member, so that no policy leans on what one of them has wrong."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from softfin.core.plant import Plant
from softfin.core.quantities import TICK_S, Command, Limits, Reading
from softfin.surrogate.streaming.force import ForcePrediction, Motion
from softfin.surrogate.streaming.member import MemberState
from softfin.surrogate.streaming.streaming import StreamingSurrogate


class OneMemberState(NamedTuple):
    """Of one fin."""

    tick: Int[Array, ""]
    """Since the start [10 ms]."""
    member: Int[Array, ""]
    state: MemberState


class OneMember(eqx.Module):
    """Meets the Plant contract: a member that the key draws, for as long as the episode lasts; a fifth of the work."""

    surrogate: StreamingSurrogate

    @property
    def limits(self) -> Limits:
        """Those of the ensemble."""
        return self.surrogate.limits

    def init(self, key: PRNGKeyArray) -> OneMemberState:
        """A member long at rest at angle 0."""
        member = jax.random.randint(key, (), 0, self.surrogate.size)
        return OneMemberState(jnp.int32(0), member, _of(self.surrogate.rest, member))

    def advance(self, state: OneMemberState, command: Command, ticks: int) -> tuple[OneMemberState, Reading]:
        """Hold the command for `ticks` samples."""
        held = Command(*(jnp.asarray(part, jnp.float32) for part in command))
        member = _of(self.surrogate.members, state.member)

        def tick(state: MemberState, _: None) -> tuple[MemberState, tuple[Motion, ForcePrediction]]:
            stepped: tuple[MemberState, tuple[Motion, ForcePrediction]] = member.step(state, held)
            return stepped

        moved, (motion, said) = jax.lax.scan(tick, state.state, length=ticks)
        time = (state.tick + 1 + jnp.arange(ticks)) * jnp.float32(TICK_S)
        reading = Reading(time, motion.angle, motion.velocity, said.force)
        return OneMemberState(state.tick + ticks, state.member, moved), reading


def _of(stack: eqx.Module | MemberState, member: Int[Array, ""]):  # type: ignore[no-untyped-def]  # whatever was stacked
    return jax.tree.map(lambda leaf: leaf[member] if eqx.is_array(leaf) else leaf, stack)


def trained_in(plant: Plant, ensemble: str) -> Plant:
    """The plant that fins are, with `ensemble` ``each``: one member of an ensemble; any other plant is itself."""
    return OneMember(plant) if ensemble == "each" and isinstance(plant, StreamingSurrogate) else plant
