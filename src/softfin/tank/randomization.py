"""Domain randomization: tanks with physical parameters sampled around the parameters of one tank.

Each parameter depends only on the key and its own name, so adding a parameter does not change the
others. Sampling can be traced: `jax.vmap` over keys returns a tank with a batch of parameters.
"""

import zlib
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import TICK_S, Command, Limits, Reading
from softfin.tank.chain import PlanarVector, Scalar
from softfin.tank.drive import DEAD_TICKS
from softfin.tank.tank import Tank, TankState

USUAL_PART = 0.15
"""Relative half-width above which temperature, drift and misalignment have their default ranges
[-]."""

ADDED_PARAMETERS = ("temperature_c", "misalignment_rad")
"""Parameters that are sampled as offsets; all others are sampled as factors."""


class DomainRandomization(Configuration):
    """Half-widths of the uniform distributions of the physical parameters; 0 keeps a parameter
    unchanged."""

    temperature_c: float = Field(5.0, ge=0, le=20)
    """Half-width of the water temperature [degrees Celsius]."""
    stiffness: float = Field(0.1, ge=0, lt=1)
    """Relative half-width of the stiffness, which depends on the batch, age and temperature of the
    silicone [-]."""
    drag: float = Field(0.1, ge=0, lt=1)
    """Relative half-width of the drag [-]."""
    added_mass: float = Field(0.05, ge=0, lt=1)
    """Relative half-width of the added mass [-]."""
    lag: float = Field(0.2, ge=0, lt=1)
    """Relative half-width of the servo lag [-]."""
    dead_time: float = Field(0.2, ge=0, lt=1)
    """Relative half-width of the delay from a command to its first effect [-]."""
    drift: float = Field(0.5, ge=0, lt=1)
    """Relative half-width of the standard deviation of the force sensor drift [-]."""
    misalignment_rad: float = Field(0.02, ge=0, le=0.5)
    """Half-width of the force sensor misalignment [rad]; the default suits a manually aligned
    mount."""

    @classmethod
    def of(cls, part: float) -> "DomainRandomization":
        """Return half-widths with the same relative value for material, water and servo.

        Temperature, drift and misalignment have their default ranges if `part` is at least 0.15.
        Below 0.15, the ranges decrease proportionally, so that 0 results in exactly the same tank.
        The geometry of the fin does not change.

        Raises:
            ConfigurationError: If `part` is negative, or 1 or more.
        """
        if not 0 <= part < 1:
            raise ConfigurationError(
                f"--randomize {part:g}: must be at least 0 (no randomization) and less than 1"
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
        """Whether all half-widths are 0, so that all sampled tanks are identical."""
        return not any(self.model_dump().values())


Change: TypeAlias = Scalar | float
"""Offset or factor of a parameter."""


def with_parameters(
    tank: Tank,
    *,
    temperature_c: Change = 0.0,
    stiffness: Change = 1.0,
    drag: Change = 1.0,
    added_mass: Change = 1.0,
    lag: Change = 1.0,
    dead_time: Change = 1.0,
    drift: Change = 1.0,
    misalignment_rad: Change = 0.0,
) -> Tank:
    """Return the tank with changed parameters. Values are offsets if the name ends in a unit,
    otherwise factors."""
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
            # The Kelvin-Voigt time, damping / stiffness, stays the same.
            fin.damping * stiffness,
            water.varied(water.temperature + temperature_c, added_mass, drag),
            tank.drive.lag * lag,
            # The delay cannot be longer than the queue of commands.
            jnp.minimum(tank.drive.dead_time * dead_time, DEAD_TICKS * TICK_S),
            tank.sensor.drift * drift,
            tank.sensor.misalignment + misalignment_rad,
        ),
    )
    return changed


def sample_tank(tank: Tank, key: PRNGKeyArray, widths: DomainRandomization | None = None) -> Tank:
    """Return the tank with parameters sampled within `widths`; if all are 0, the tank itself."""
    widths = widths or DomainRandomization()
    if widths.is_none:
        return tank

    def one(name: str, width: float) -> Scalar:
        # CRC-32 instead of hash(), which differs between processes.
        own = jax.random.fold_in(key, zlib.crc32(name.encode()))
        return (name not in ADDED_PARAMETERS) + jax.random.uniform(own, minval=-width, maxval=width)

    return with_parameters(
        tank, **{name: one(name, width) for name, width in widths.model_dump().items()}
    )


RandomizedTankState: TypeAlias = tuple[Tank, TankState]
"""Sampled tank and its state."""


class RandomizedTank(eqx.Module):
    """A plant that samples new physical parameters at each `init`."""

    tank: Tank
    """Tank around which parameters are sampled."""
    widths: DomainRandomization = eqx.field(static=True)

    @property
    def limits(self) -> Limits:
        """Limits of the tank; they do not depend on the sampled parameters."""
        return self.tank.limits

    def init(self, key: PRNGKeyArray) -> RandomizedTankState:
        """Sample a tank and return the tank and its state at rest."""
        parameters, own = jax.random.split(key)
        tank = sample_tank(self.tank, parameters, self.widths)
        return tank, tank.init(own)

    def true_force(self, state: RandomizedTankState) -> PlanarVector:
        """Return the mean force of the fin on its mount over the last tick [N]."""
        tank, inner = state
        return tank.true_force(inner)

    def torque(self, state: RandomizedTankState) -> Float[Array, "2"]:
        """Return the mean torques over the last tick [N m]: on the fin about the shaft, and of the
        motor."""
        tank, inner = state
        return tank.torque(inner)

    def advance(
        self, state: RandomizedTankState, command: Command, ticks: int
    ) -> tuple[RandomizedTankState, Reading]:
        """Advance the sampled tank."""
        tank, inner = state
        inner, reading = tank.advance(inner, command, ticks)
        return (tank, inner), reading
