"""Random commands that excite the full dynamics of a fin: a target angle and velocity, held for a
random time (paper Sec. III-A).

`collect` issues one of these commands per tick to a plant.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import pydantic
from jaxtyping import PRNGKeyArray

from softfin.core.configuration import Configuration
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits

Commands = Callable[[PRNGKeyArray, int, Limits], Command]
"""Function that generates the commands for a log, one per tick, from a key, the number of ticks and
the limits; it must be traceable by JAX."""


class ExcitationConfig(Configuration):
    """Range of the hold times of random commands."""

    hold_min_s: float = pydantic.Field(default=0.2, gt=0, multiple_of=TICK_S)
    """Minimum hold time [s], a multiple of 10 ms. The default is below the 0.33 s of a 3 Hz
    controller, so that the data contain strokes that are cut short."""
    hold_max_s: float = pydantic.Field(default=1.5, gt=0, multiple_of=TICK_S)
    """Maximum hold time [s], a multiple of 10 ms. Most strokes end earlier, so the data also
    contain the fin at rest."""

    @pydantic.model_validator(mode="after")
    def _in_order(self) -> "ExcitationConfig":
        if self.hold_max_s < self.hold_min_s:
            raise ValueError(
                f"hold_max_s = {self.hold_max_s} must be at least hold_min_s = {self.hold_min_s}"
            )
        return self

    def __call__(self, key: PRNGKeyArray, rows: int, limits: Limits) -> Command:
        """Draw one command per tick, fields ``(rows,)``; angle, velocity and hold time are
        uniformly distributed."""
        shortest = round(self.hold_min_s * RATE_HZ)
        longest = round(self.hold_max_s * RATE_HZ)
        # Enough commands even if all hold times are the minimum; the number must be static for JAX.
        holds = -(-rows // shortest)
        angle_key, velocity_key, hold_key = jax.random.split(key, 3)
        angle = jax.random.uniform(
            angle_key, (holds,), minval=limits.angle_min, maxval=limits.angle_max
        )
        velocity = jax.random.uniform(
            velocity_key, (holds,), minval=limits.velocity_min, maxval=limits.velocity_max
        )
        ends = jnp.cumsum(jax.random.randint(hold_key, (holds,), shortest, longest + 1))
        # Row k belongs to the first hold that ends after k.
        current = jnp.searchsorted(ends, jnp.arange(rows), side="right")
        return Command(angle[current], velocity[current])
