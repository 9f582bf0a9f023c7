"""A tank of which every start is another one: conditions are drawn with the key that starts it (domain randomisation).

Whatever runs a plant over several keys so runs over as many tanks, side by side in one program.
"""

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.quantities import Command, Limits, Reading
from softfin.tank.conditions import Spread, randomised
from softfin.tank.tank import Tank, TankState


class DrawnState(NamedTuple):
    """The tank that was drawn, and its state."""

    tank: Tank
    state: TankState


class DrawnTanks(eqx.Module):
    """Meets the Plant contract."""

    tank: Tank
    """Whose conditions the others are drawn about."""
    spread: Spread = eqx.field(static=True)

    @property
    def limits(self) -> Limits:
        """Those of the tank: its drive takes the same commands whatever the water does."""
        return self.tank.limits

    def init(self, key: PRNGKeyArray) -> DrawnState:
        """Another tank, its fin at rest at angle 0."""
        conditions, own = jax.random.split(key)
        tank = randomised(self.tank, conditions, self.spread)
        return DrawnState(tank, tank.init(own))

    def advance(self, state: DrawnState, command: Command, ticks: int) -> tuple[DrawnState, Reading]:
        """As the tank that was drawn."""
        moved, reading = state.tank.advance(state.state, command, ticks)
        return DrawnState(state.tank, moved), reading

    def shape(self, state: DrawnState) -> Float[Array, "points 2"]:
        """Where the fin is."""
        return state.tank.shape(state.state)
