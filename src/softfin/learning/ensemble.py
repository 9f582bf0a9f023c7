"""Training over an ensemble: every fin is another member, so that no policy exploits the errors of one of them."""

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Int, PRNGKeyArray

from softfin.core.plant import EnsemblePlant, State
from softfin.core.quantities import Command, Limits, Reading


class OneMemberState(NamedTuple):
    """One fin."""

    member: Int[Array, ""]
    """Index of its member."""
    state: State


class OneMember(eqx.Module):
    """Meets the Plant contract: a member that the key draws, for as long as the episode lasts; a fifth of the work."""

    ensemble: EnsemblePlant

    @property
    def limits(self) -> Limits:
        """Limits of the ensemble."""
        return self.ensemble.limits

    def init(self, key: PRNGKeyArray) -> OneMemberState:
        """A drawn member, at rest at angle 0."""
        member = jax.random.randint(key, (), 0, self.ensemble.size)
        return OneMemberState(member, self.ensemble.member(member).init(jax.random.fold_in(key, 1)))

    def advance(self, state: OneMemberState, command: Command, ticks: int) -> tuple[OneMemberState, Reading]:
        """Hold the command for `ticks` samples."""
        after, reading = self.ensemble.member(state.member).advance(state.state, command, ticks)
        return OneMemberState(state.member, after), reading
