"""A fin that changes while it runs."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.quantities import RATE_HZ, Command, Limits, Reading
from softfin.tank.tank import Tank, TankState


class ChangingTank(eqx.Module):
    """A tank whose parameters change linearly into the parameters of a second tank."""

    before: Tank
    after: Tank
    start_ticks: Float[Array, ""]
    """Time at which the change starts [10 ms]."""
    end_ticks: Float[Array, ""]
    """Time at which the change is complete [10 ms]."""

    @classmethod
    def between(
        cls, before: Tank, after: Tank, start_s: float | int, end_s: float | int
    ) -> "ChangingTank":
        """Build a tank that changes between two times [s]; if they are equal, it changes at
        once."""
        return cls(before, after, jnp.float32(RATE_HZ * start_s), jnp.float32(RATE_HZ * end_s))

    @property
    def limits(self) -> Limits:
        """Limits of the commands, which do not change."""
        return self.before.limits

    def init(self, key: PRNGKeyArray) -> TankState:
        """Return the state at rest before the change."""
        return self.before.init(key)

    def advance(self, state: TankState, command: Command, ticks: int) -> tuple[TankState, Reading]:
        """Advance the tank with the parameters at the start of the `ticks`."""
        duration = jnp.maximum(self.end_ticks - self.start_ticks, 1)
        share = jnp.clip((state.ticks - self.start_ticks) / duration, 0, 1)
        now: Tank = jax.tree.map(lambda a, b: a + (b - a) * share, self.before, self.after)
        return now.advance(state, command, ticks)

    def true_force(self, state: TankState) -> Float[Array, "2"]:
        """Return the mean force of the fin on its mount over the last tick [N]."""
        return state.force

    def torque(self, state: TankState) -> Float[Array, "2"]:
        """Return the mean torques over the last tick [N m]: on the fin about the shaft, and of the
        motor."""
        return state.torque
