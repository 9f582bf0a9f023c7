"""The water around the fin: the loads on each plate of the chain, and the flow that the fin itself
has caused.

- Reactive: the added mass of a thin plate, along its normal alone, stands in the chain's inertia
  (Lighthill 1960); its momentum is shed at the tip by the large-amplitude elongated-body theory
  (Lighthill 1971; Candelier, Boyer and Leroyer 2011): force m w u n - m w^2/2 d there, with w and u
  the tip's velocities along its n and outwards along d.
- Resistive: quadratic drag along the normal (Taylor 1952; Morison 1950), with a coefficient that is
  constant or falls with the Keulegan-Carpenter number of the plate's recent strokes; skin friction
  along the plate (Blasius).
- Memory: the momentum that drag, friction and tip take from the fin stays in the water around it,
  which streams on until it has decayed. All loads are those of the motion relative to this stream;
  it does not contain the momentum of the added mass, which the fin takes back.

Left out: free surface and walls, history (Basset) forces, and the pressure of an accelerating
stream.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S
from softfin.tank.chain import (
    Moments,
    PerPlate,
    PlanarVector,
    PlateMotion,
    PlateWrench,
    Scalar,
)
from softfin.tank.fin import FinConfig, Surroundings, plate_moments
from softfin.tank.sensor import remaining


class WaterConfig(Configuration):
    """The water, the coefficients of its loads, and its memory.

    Drag and stream come from a calibration against the published fin (docs/appendix/tank.md); added
    mass, tip, friction are theory.
    """

    temperature_c: float = Field(20.0, ge=0, le=40)
    """Temperature of fresh water [degrees Celsius]; gives its density and viscosity."""
    added_mass_coefficient: float = Field(1.0, ge=0)
    """Added mass per length divided by that of a long flat plate, rho pi/4 span^2 [-]."""
    drag_coefficient: float = Field(5.46, ge=0)
    """Drag coefficient for the motion relative to the stream, at a Keulegan-Carpenter number of 5
    if it depends on that [-]."""
    drag_exponent: float = Field(0.0, ge=0, le=1)
    """Exponent with which drag falls with the Keulegan-Carpenter number [-]: 0 is constant, 1/3 is
    for thin plates (Graham 1980)."""
    friction_coefficient: float = Field(1.328, ge=0)
    """Blasius: skin friction is this / sqrt(Reynolds number of the length) on each of both faces
    [-]."""
    tip_coefficient: float = Field(1.0, ge=0)
    """Fraction of the elongated-body tip term [-]; 0 leaves it out."""
    wake_memory_s: float = Field(1.0, gt=0)
    """Time over which strokes are averaged [s]; used if drag depends on them."""
    stream_mass_kg: float = Field(2.17, ge=0.2)
    """Mass of water that takes up the momentum of the fin [kg]: about a cube of 0.13 m. Below 0.2
    the stream would change too fast for its step of one tick."""
    stream_decay_s: float = Field(0.241, ge=0)
    """Time constant with which the stream decays [s]; 0: the water stays still."""


REFERENCE_STROKE = 5.0
"""Keulegan-Carpenter number for which the drag coefficient is stated."""

MIN_STROKE = 0.5
"""Keulegan-Carpenter number below which drag no longer grows."""

SLOWEST_FRICTION_M_S = 0.01
"""Speed below which skin friction is linear, like Stokes's, so that its slope at rest is finite."""

GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
"""Two points along a plate integrate its drag well if its ends move to the same side."""


class Flow(NamedTuple):
    """Motion that the fin has left in the water."""

    stream: PlanarVector
    """Velocity of the water round the fin, (x, y) [m/s]."""
    excursion: PerPlate
    """Recent displacement of each plate's middle along its normal [m]."""
    square: PerPlate
    """Recent mean of the excursion's square [m2]."""


class Water(eqx.Module):
    """Loads of the water as arrays, per length of each plate."""

    plate_length: Scalar
    temperature: Scalar
    """Temperature of the water [degrees Celsius]."""
    inertia: Moments
    """Added mass of each plate [kg, kg m, kg m2]."""
    drag: Float[Array, "2 plates"]
    """Normal force per length over velocity squared, at two points of each plate [kg/m2]."""
    friction: PerPlate
    """Tangential force per length over velocity to the power 3/2 [kg/m2 (m/s)^(1/2)]."""
    tip: PerPlate
    """Added mass per length at the outer end of each plate where water leaves the fin: zero except
    for the last [kg/m]."""
    span: PerPlate
    """Span at the middle of each plate [m]."""
    drag_exponent: Scalar
    wake_memory: Scalar
    stream_mass: Scalar
    stream_decay: Scalar

    def __init__(self, config: WaterConfig, fin: FinConfig):
        rho = _density(config.temperature_c)
        nu = _viscosity(config.temperature_c)
        plate = fin.length_m / fin.plates
        inner = np.arange(fin.plates) * plate
        section = float(config.added_mass_coefficient * rho * np.pi / 4)
        zeroth, first, second = plate_moments(fin, lambda s: section * fin.span(s) ** 2)
        span = fin.span(inner + plate / 2)
        self.plate_length = jnp.asarray(plate, float)
        self.temperature = jnp.asarray(config.temperature_c, float)
        self.inertia = Moments(zeroth, first, second, jnp.zeros_like(zeroth))
        self.drag = jnp.asarray(
            0.5 * rho * config.drag_coefficient * fin.span(inner + plate * GAUSS[:, None])
        )
        self.friction = jnp.asarray(
            config.friction_coefficient * np.sqrt(nu / fin.length_m) * rho * span
        )
        leaving = config.tip_coefficient * section * (fin.span_m * fin.tip_span_ratio) ** 2
        self.tip = jnp.asarray(leaving * np.eye(fin.plates)[-1])
        self.span = jnp.asarray(span)
        self.drag_exponent = jnp.asarray(config.drag_exponent, float)
        self.wake_memory = jnp.asarray(config.wake_memory_s, float)
        self.stream_mass = jnp.asarray(config.stream_mass_kg, float)
        self.stream_decay = jnp.asarray(config.stream_decay_s, float)

    def varied(
        self, temperature: Scalar, added_mass: Scalar | float = 1.0, drag: Scalar | float = 1.0
    ) -> "Water":
        """Return water of another temperature [degrees Celsius] with its loads multiplied by
        factors; the tip term uses that of the added mass."""
        density = _density(temperature) / _density(self.temperature)
        friction = density * jnp.sqrt(_viscosity(temperature) / _viscosity(self.temperature))
        inertia = jax.tree.map(lambda moment: moment * density * added_mass, self.inertia)
        changed: Water = eqx.tree_at(
            lambda water: (water.temperature, water.inertia, water.tip, water.drag, water.friction),
            self,
            (
                temperature,
                inertia,
                self.tip * density * added_mass,
                self.drag * density * drag,
                self.friction * friction,
            ),
        )
        return changed

    def rest(self) -> Flow:
        """Return the flow of still water."""
        zero = jnp.zeros_like(self.span)
        return Flow(jnp.zeros(2, zero.dtype), zero, zero)

    def around(self, flow: Flow) -> Surroundings:
        """Return the surroundings of the fin for a given flow."""
        # 2 pi amplitude / span, for the amplitude of a sine with that mean square.
        number = (
            jnp.sqrt(8 * jnp.pi**2 * flow.square / self.span**2 + MIN_STROKE**2) / REFERENCE_STROKE
        )
        drag = self.drag * number**-self.drag_exponent
        return Surroundings(self.inertia, flow.stream, lambda motion: self._loads(motion, drag))

    def stirred(self, flow: Flow, motion: PlateMotion, force: PlanarVector) -> Flow:
        """Return the flow one tick later, given the plates' motion relative to it and the mean
        force of its loads [N]."""
        share = remaining(self.stream_decay)
        stream = share * flow.stream - (1 - share) * self.stream_decay / self.stream_mass * force
        share = remaining(self.wake_memory)
        excursion = share * flow.excursion + TICK_S * (
            motion.normal + self.plate_length / 2 * motion.turning
        )
        return Flow(stream, excursion, share * flow.square + (1 - share) * excursion**2)

    def _loads(
        self, motion: PlateMotion, drag: Float[Array, "2 plates"]
    ) -> tuple[Moments, PlateWrench]:
        """Return the resistance to the motion relative to the stream [kg/s], and the suction at the
        tip [N]."""
        length = self.plate_length
        places = [length * place for place in GAUSS.tolist()]
        drags = [
            d * length / 2 * jnp.abs(motion.normal + s * motion.turning)
            for d, s in zip(drag, places, strict=True)
        ]
        # Water that flows inwards over the tip is at rest and carries no momentum, so the tip never
        # adds energy to the fin: the power of its force is -m w^2 |u|/2.
        leaving = self.tip * jnp.maximum(-motion.along, 0.0)
        speed = jnp.sqrt(jnp.sqrt(motion.along**2 + SLOWEST_FRICTION_M_S**2))
        resistance = Moments(
            drags[0] + drags[1] + leaving,
            drags[0] * places[0] + drags[1] * places[1] + leaving * length,
            drags[0] * places[0] ** 2 + drags[1] * places[1] ** 2 + leaving * length**2,
            self.friction * length * speed,
        )
        zero = jnp.zeros_like(motion.along)
        suction = PlateWrench(
            zero, -0.5 * self.tip * (motion.normal + length * motion.turning) ** 2, zero
        )
        return resistance, suction


def _density(temperature_c: Scalar | float) -> Scalar | float:
    """Density of fresh water at 1 atm [kg/m3], 0 to 40 degrees Celsius (Tanaka et al. 2001,
    Metrologia 38, 301)."""
    t = temperature_c
    return 999.974950 * (1 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))


def _viscosity(temperature_c: Scalar | float) -> Scalar | float:
    """Kinematic viscosity of fresh water [m2/s] (Vogel's equation)."""
    return 2.414e-5 * 10 ** (247.8 / (temperature_c + 133.15)) / _density(temperature_c)
