"""Tanks that differ: fin and conditions drawn by name, for test logs under other conditions and domain randomisation.

Every draw depends on the key and its own name alone, so a condition that is added later leaves the others as they were.
Draws are traceable: `jax.vmap` over keys gives one tank that holds a batch of parameters.
"""

import zlib
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.tank.tank import Tank

USUAL_PART = 0.15
"""Part from which on temperature, drift and mount are spread as they usually are [-]."""


class Spread(Configuration):
    """Half the width of the range that each condition is drawn from, uniformly; 0 keeps the tank's own value."""

    temperature_c: float = Field(5.0, ge=0, le=20)
    """Of the water, either side of the tank's [degrees Celsius]."""
    stiffness: float = Field(0.1, ge=0, lt=1)
    """Relative: silicone of another batch, age and temperature [-]."""
    length: float = Field(0.0, ge=0, lt=1)
    """Of the fin, relative [-]; as a rule it is one fin that is tested under several conditions."""
    thickness: float = Field(0.0, ge=0, lt=1)
    """Likewise [-]."""
    drag: float = Field(0.1, ge=0, lt=1)
    """Relative [-]."""
    added_mass: float = Field(0.05, ge=0, lt=1)
    """Relative [-]."""
    lag: float = Field(0.2, ge=0, lt=1)
    """Of the servo, relative [-]."""
    drift: float = Field(0.5, ge=0, lt=1)
    """Standard deviation of the force sensor's drift, relative [-]."""
    misalignment_rad: float = Field(0.02, ge=0, le=0.5)
    """Of the force sensor, either side of the tank's [rad]; a mount screwed down by hand."""

    @classmethod
    def of(cls, part: float) -> "Spread":
        """Material, water and servo within the same part of their values either side, on one and the same fin.

        Temperature, drift and mount have their usual spread from a part of 0.15 on; below, it is smaller in proportion,
        so that 0 is the very same tank. Raises ConfigurationError outside 0 <= part < 1.
        """
        if not 0 <= part < 1:
            raise ConfigurationError(f"spread {part:g}: give a part from 0, the very same tank, to less than 1")
        usual, share = cls(), min(1.0, part / USUAL_PART)
        own = {name: share * getattr(usual, name) for name in ("temperature_c", "drift", "misalignment_rad")}
        return usual.merged(own | dict.fromkeys(("stiffness", "drag", "added_mass", "lag"), part), "spread")

    @property
    def is_none(self) -> bool:
        """Whether all widths are 0, so that every tank drawn is the very same one."""
        return not any(self.model_dump().values())


class Conditions(NamedTuple):
    """How a tank differs from the one it was drawn from: offsets where a unit stands in the name, factors elsewhere."""

    temperature_c: Float[Array, ""]
    stiffness: Float[Array, ""]
    length: Float[Array, ""]
    thickness: Float[Array, ""]
    drag: Float[Array, ""]
    added_mass: Float[Array, ""]
    lag: Float[Array, ""]
    drift: Float[Array, ""]
    misalignment_rad: Float[Array, ""]


_OFFSETS = {"temperature_c", "misalignment_rad"}


def draw(key: PRNGKeyArray, spread: Spread | None = None) -> Conditions:
    """Conditions within `spread`, by default the documented one."""
    widths = (spread or Spread()).model_dump()

    def one(name: str) -> Float[Array, ""]:
        own = jax.random.fold_in(key, zlib.crc32(name.encode()))
        return (name not in _OFFSETS) + jax.random.uniform(own, minval=-widths[name], maxval=widths[name])

    return Conditions(**{name: one(name) for name in Conditions._fields})


def under(tank: Tank, conditions: Conditions) -> Tank:
    """The tank under those conditions."""
    water = tank.water.at(tank.water.temperature + conditions.temperature_c)
    changed: Tank = eqx.tree_at(
        lambda tank: (
            tank.fin,
            tank.water,
            tank.drive.lag,
            tank.sensor.drift,
            tank.sensor.misalignment,
        ),
        tank,
        (
            tank.fin.scaled(conditions.stiffness, conditions.length, conditions.thickness),
            water.scaled(drag=conditions.drag, added_mass=conditions.added_mass, length=conditions.length),
            tank.drive.lag * conditions.lag,
            tank.sensor.drift * conditions.drift,
            tank.sensor.misalignment + conditions.misalignment_rad,
        ),
    )
    return changed


def randomised(tank: Tank, key: PRNGKeyArray, spread: Spread | None = None) -> Tank:
    """The tank under conditions that the key draws; itself, to the last bit, where nothing is spread."""
    return tank if spread is not None and spread.is_none else under(tank, draw(key, spread))
