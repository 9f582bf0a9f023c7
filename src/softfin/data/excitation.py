"""Random commands that show a fin's whole dynamics: a target angle and velocity, held for a random
time (Sec. III-A).

A key goes in, one command a tick comes out; `collect` issues them to a plant.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import pydantic
from jaxtyping import PRNGKeyArray

from softfin.core.configuration import Configuration
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits

Commands = Callable[[PRNGKeyArray, int, Limits], Command]
"""Function that makes the commands of a log from a key, their number and limits: one command per
tick, traceable."""


class ExcitationConfig(Configuration):
    """How long each random command is held."""

    hold_min_s: float = pydantic.Field(default=0.2, gt=0, multiple_of=TICK_S)
    """Shortest hold [s], on the 10 ms grid; below the 0.33 s of a 3 Hz controller, so that strokes
    are cut as short."""
    hold_max_s: float = pydantic.Field(default=1.5, gt=0, multiple_of=TICK_S)
    """Longest hold [s], on the 10 ms grid; most strokes end within it, so that the fin at rest is
    learnt too."""

    @pydantic.model_validator(mode="after")
    def _in_order(self) -> "ExcitationConfig":
        if self.hold_max_s < self.hold_min_s:
            raise ValueError(
                f"hold_max_s = {self.hold_max_s} must be at least hold_min_s = {self.hold_min_s}"
            )
        return self

    def __call__(self, key: PRNGKeyArray, rows: int, limits: Limits) -> Command:
        """Make one command per tick, fields ``(rows,)``: all three random quantities uniform."""
        shortest = round(self.hold_min_s * RATE_HZ)
        longest = round(self.hold_max_s * RATE_HZ)
        # Enough even if all holds are the shortest.
        holds = -(-rows // shortest)
        angle_key, velocity_key, hold_key = jax.random.split(key, 3)
        angle = jax.random.uniform(
            angle_key, (holds,), minval=limits.angle_min, maxval=limits.angle_max
        )
        velocity = jax.random.uniform(
            velocity_key, (holds,), minval=limits.velocity_min, maxval=limits.velocity_max
        )
        ends = jnp.cumsum(jax.random.randint(hold_key, (holds,), shortest, longest + 1))
        # The hold of a row is the first that ends after it.
        current = jnp.searchsorted(ends, jnp.arange(rows), side="right")
        return Command(angle[current], velocity[current])
