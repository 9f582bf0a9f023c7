"""Still water round the fin: the loads on each plate of the chain.

- Reactive: the added mass of a thin plate, along its normal alone, stands in the chain's inertia (Lighthill 1960); its
  momentum leaves over the tip by the large-amplitude elongated-body theory (Lighthill 1971; Candelier, Boyer and
  Leroyer 2011): force m w u n - m w^2/2 d there, with w and u the tip's velocities along its n and outwards along d.
- Resistive: quadratic drag along the normal (Taylor 1952; Morison 1950), skin friction along the plate (Blasius).

Left out: the stream that the fin sets moving in the tank, free surface and walls, and history (Basset) forces.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.configuration import Configuration
from softfin.tank.chain import Moments, Motion, PerPlate, Wrench
from softfin.tank.fin import FinConfig


class WaterConfig(Configuration):
    """The water and the coefficients of its loads; drag and added mass came out of a fit to the published fin."""

    temperature_c: float = Field(20.0, ge=0, le=40)
    """Of fresh water [degrees Celsius]; gives its density and viscosity."""
    added_mass_coefficient: float = Field(1.26, ge=0)
    """Added mass per length over that of a long flat plate, rho pi/4 span^2 [-]."""
    drag_coefficient: float = Field(5.2, ge=0)
    """Of a plate beating through a few thicknesses of its own wake; 2 in a steady stream [-]."""
    friction_coefficient: float = Field(1.328, ge=0)
    """Blasius: skin friction is this / sqrt(Reynolds number of the length) on each of both faces [-]."""
    tip_coefficient: float = Field(1.0, ge=0)
    """Share of the elongated-body tip term [-]; 0 leaves it out."""


SLOWEST_FRICTION_M_S = 0.01
"""Below this speed skin friction grows linearly with it, as Stokes's does, so that its slope at rest is finite."""

GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
"""Two points along a plate integrate its mass exactly, and its drag wherever its ends move to the same side."""


Scale = Float[Array, ""] | float


class Water(eqx.Module):
    """What a step needs to know of the water, per length of each plate."""

    plate_length: Float[Array, ""]
    temperature: Float[Array, ""]
    """[degrees Celsius]"""
    added_mass: PerPlate
    """Along the normal [kg/m]."""
    drag: PerPlate
    """Normal force per length over velocity squared [kg/m2]."""
    friction: PerPlate
    """Tangential force per length over velocity to the power 3/2 [kg/m2 (m/s)^(1/2)]."""
    tip: PerPlate
    """Added mass per length at the outer end of each plate where water leaves the fin: zero but for the last [kg/m]."""

    def __init__(self, config: WaterConfig, fin: FinConfig):
        rho, nu = _density(config.temperature_c), _viscosity(config.temperature_c)
        added_mass = config.added_mass_coefficient * rho * np.pi / 4 * fin.span_m**2
        friction = config.friction_coefficient * np.sqrt(nu / fin.length_m) * rho * fin.span_m
        each = np.ones(fin.plates)
        self.plate_length = jnp.asarray(fin.length_m / fin.plates)
        self.temperature = jnp.asarray(config.temperature_c)
        self.added_mass = jnp.asarray(added_mass * each)
        self.drag = jnp.asarray(0.5 * rho * config.drag_coefficient * fin.span_m * each)
        self.friction = jnp.asarray(friction * each)
        self.tip = jnp.asarray(config.tip_coefficient * added_mass * np.eye(fin.plates)[-1])

    def at(self, temperature: Float[Array, ""]) -> "Water":
        """The same fin in water of another temperature [degrees Celsius]."""
        density = _density(temperature) / _density(self.temperature)
        friction = jnp.sqrt(_viscosity(temperature) / _viscosity(self.temperature))
        water = self.scaled(added_mass=density, drag=density, friction=density * friction)
        changed: Water = eqx.tree_at(lambda water: water.temperature, water, temperature)
        return changed

    def scaled(self, added_mass: Scale = 1.0, drag: Scale = 1.0, friction: Scale = 1.0) -> "Water":
        """With its loads multiplied; the tip goes with the added mass."""
        changed: Water = eqx.tree_at(
            lambda water: (water.added_mass, water.tip, water.drag, water.friction),
            self,
            (self.added_mass * added_mass, self.tip * added_mass, self.drag * drag, self.friction * friction),
        )
        return changed

    def inertia(self) -> Moments:
        """Added mass of each plate [kg, kg m, kg m2]."""
        mass, length = self.added_mass * self.plate_length, self.plate_length
        return Moments(mass, mass * length / 2, mass * length**2 / 3, jnp.zeros_like(mass))

    def loads(self, motion: Motion) -> tuple[Moments, Wrench]:
        """What resists the motion [kg/s], and the suction at the tip [N]."""
        length = self.plate_length
        places = [length * place for place in GAUSS.tolist()]
        drags = [self.drag * length / 2 * jnp.abs(motion.normal + s * motion.turning) for s in places]
        # Water that comes over the tip from outside is at rest and brings no momentum with it. So the tip never feeds
        # energy into the fin: the power of its force is -m w^2 |u|/2.
        leaving = self.tip * jnp.maximum(-motion.along, 0.0)
        speed = jnp.sqrt(jnp.sqrt(motion.along**2 + SLOWEST_FRICTION_M_S**2))
        resistance = Moments(
            drags[0] + drags[1] + leaving,
            drags[0] * places[0] + drags[1] * places[1] + leaving * length,
            drags[0] * places[0] ** 2 + drags[1] * places[1] ** 2 + leaving * length**2,
            self.friction * length * speed,
        )
        zero = jnp.zeros_like(motion.along)
        suction = Wrench(zero, -0.5 * self.tip * (motion.normal + length * motion.turning) ** 2, zero)
        return resistance, suction


def _density(temperature_c: Scale) -> Scale:
    """Of fresh water at one atmosphere [kg/m3], 0 to 40 degrees Celsius (Tanaka et al. 2001, Metrologia 38, 301)."""
    t = temperature_c
    return 999.974950 * (1 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))


def _viscosity(temperature_c: Scale) -> Scale:
    """Kinematic, of fresh water [m2/s] (Vogel's equation)."""
    return 2.414e-5 * 10 ** (247.8 / (temperature_c + 133.15)) / _density(temperature_c)
