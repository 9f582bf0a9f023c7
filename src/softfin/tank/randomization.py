"""Domain randomization: tanks whose physical parameters are sampled around those of one tank.

Every parameter depends only on the key and its own name, so adding one leaves the others unchanged.
Sampling is traceable: `jax.vmap` over keys gives one tank with a batch of parameters.
"""

import zlib
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import TICK_S, Command, Limits, Reading
from softfin.tank.chain import PlanarVector, Scalar
from softfin.tank.drive import DEAD_TICKS
from softfin.tank.tank import Tank, TankState

USUAL_PART = 0.15
"""Relative half-width from which temperature, drift and mount have their usual ranges [-]."""

ADDED_PARAMETERS = ("temperature_c", "misalignment_rad")
"""Parameters that are added to the tank's own; the others multiply them."""


class DomainRandomization(Configuration):
    """Half-width of the uniform range of each physical parameter; 0 keeps the tank's own value."""

    temperature_c: float = Field(5.0, ge=0, le=20)
    """Temperature of the water, around the tank's [degrees Celsius]."""
    stiffness: float = Field(0.1, ge=0, lt=1)
    """Stiffness, relative: silicone of another batch, age and temperature [-]."""
    drag: float = Field(0.1, ge=0, lt=1)
    """Drag, relative [-]."""
    added_mass: float = Field(0.05, ge=0, lt=1)
    """Added mass, relative [-]."""
    lag: float = Field(0.2, ge=0, lt=1)
    """Lag of the servo, relative [-]."""
    dead_time: float = Field(0.2, ge=0, lt=1)
    """Delay from a command to the motion that follows it, relative [-]."""
    drift: float = Field(0.5, ge=0, lt=1)
    """Standard deviation of the force sensor's drift, relative [-]."""
    misalignment_rad: float = Field(0.02, ge=0, le=0.5)
    """Misalignment of the force sensor, around the tank's [rad]; for a mount fitted by hand."""

    @classmethod
    def of(cls, part: float) -> "DomainRandomization":
        """Return widths with the same fraction for material, water and servo; the geometry of the
        fin is not changed.

        Temperature, drift and mount have their usual range from a fraction of 0.15; below, it is
        proportionally smaller, so that 0 gives exactly the same tank. Raises ConfigurationError
        outside 0 <= part < 1.
        """
        if not 0 <= part < 1:
            raise ConfigurationError(
                f"--randomize {part:g}: give a fraction from 0 (the same tank) to less than 1"
            )
        usual = cls()
        share = min(1.0, part / USUAL_PART)
        return cls(
            temperature_c=share * usual.temperature_c,
            stiffness=part,
            drag=part,
            added_mass=part,
            lag=part,
            dead_time=part,
            drift=share * usual.drift,
            misalignment_rad=share * usual.misalignment_rad,
        )

    @property
    def is_none(self) -> bool:
        """Whether all widths are 0, so that every sampled tank is the same."""
        return not any(self.model_dump().values())


def with_parameters(
    tank: Tank,
    *,
    temperature_c: Scalar | float = 0.0,
    stiffness: Scalar | float = 1.0,
    drag: Scalar | float = 1.0,
    added_mass: Scalar | float = 1.0,
    lag: Scalar | float = 1.0,
    dead_time: Scalar | float = 1.0,
    drift: Scalar | float = 1.0,
    misalignment_rad: Scalar | float = 0.0,
) -> Tank:
    """Return the tank with other parameters: offsets if the name has a unit, otherwise factors."""
    water = tank.water
    fin = tank.fin
    changed: Tank = eqx.tree_at(
        lambda tank: (
            tank.fin.stiffness,
            tank.fin.damping,
            tank.water,
            tank.drive.lag,
            tank.drive.dead_time,
            tank.sensor.drift,
            tank.sensor.misalignment,
        ),
        tank,
        (
            fin.stiffness * stiffness,
            # Damping keeps its time.
            fin.damping * stiffness,
            water.varied(water.temperature + temperature_c, added_mass, drag),
            tank.drive.lag * lag,
            # The delay cannot exceed the queue of waiting commands.
            jnp.minimum(tank.drive.dead_time * dead_time, DEAD_TICKS * TICK_S),
            tank.sensor.drift * drift,
            tank.sensor.misalignment + misalignment_rad,
        ),
    )
    return changed


def sample_tank(tank: Tank, key: PRNGKeyArray, widths: DomainRandomization | None = None) -> Tank:
    """Return the tank with parameters sampled within `widths`; bit for bit the same tank if all are
    0."""
    widths = widths or DomainRandomization()
    if widths.is_none:
        return tank

    def one(name: str, width: float) -> Scalar:
        own = jax.random.fold_in(key, zlib.crc32(name.encode()))
        return (name not in ADDED_PARAMETERS) + jax.random.uniform(own, minval=-width, maxval=width)

    return with_parameters(
        tank, **{name: one(name, width) for name, width in widths.model_dump().items()}
    )


RandomizedTankState: TypeAlias = tuple[Tank, TankState]
"""The sampled tank, and its state."""


class RandomizedTank(eqx.Module):
    """A plant that becomes a new tank at every `init`, whose key samples the physical
    parameters."""

    tank: Tank
    """The tank around which the others are sampled."""
    widths: DomainRandomization = eqx.field(static=True)

    @property
    def limits(self) -> Limits:
        """Limits of the tank; they do not depend on the sampled parameters."""
        return self.tank.limits

    def init(self, key: PRNGKeyArray) -> RandomizedTankState:
        """Sample a tank, its fin at rest at angle 0."""
        parameters, own = jax.random.split(key)
        tank = sample_tank(self.tank, parameters, self.widths)
        return tank, tank.init(own)

    def true_force(self, state: RandomizedTankState) -> PlanarVector:
        """Return the mean force of the sampled tank's fin on its mount over the last tick [N]."""
        tank, inner = state
        return tank.true_force(inner)

    def advance(
        self, state: RandomizedTankState, command: Command, ticks: int
    ) -> tuple[RandomizedTankState, Reading]:
        """Advance the sampled tank."""
        tank, inner = state
        inner, reading = tank.advance(inner, command, ticks)
        return (tank, inner), reading
