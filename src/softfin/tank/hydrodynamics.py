"""The water around the fin: its loads on the plates of the chain, and the flow that the fin
causes.

- Reactive loads: the added mass of a thin plate acts only along its normal and is part of the
  chain's inertia (Lighthill 1960). Its momentum is shed at the tip according to large-amplitude
  elongated-body theory (Lighthill 1971; Candelier, Boyer and Leroyer 2011): the force at the tip is
  m w u n - m w^2/2 d, where w is the velocity along n and u the velocity outwards along d.
- Resistive loads: quadratic drag along the normal (Taylor 1952; Morison 1950) and skin friction
  along the plate (Blasius). The drag coefficient is constant, or decreases with the
  Keulegan-Carpenter number of the recent strokes of the plate.
- Memory: the momentum that drag, friction and the tip transfer to the water persists as a stream
  and decays. All loads depend on the motion relative to this stream. The stream does not contain
  the added-mass momentum, which returns to the fin.

Not modelled: free surface and walls, history (Basset) forces, and the pressure of an accelerating
stream. Equations: docs/appendix/tank.md, "Water".
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
    """Coefficients of the hydrodynamic loads, and the memory of the water.

    The default drag and stream coefficients come from a calibration against the published fin
    (docs/appendix/tank.md). Those of added mass, tip and friction come from theory.
    """

    temperature_c: float = Field(20.0, ge=0, le=40)
    """Temperature of the fresh water [degrees Celsius]; determines its density and viscosity."""
    added_mass_coefficient: float = Field(1.0, ge=0)
    """Added mass per length, relative to that of a long flat plate, rho pi/4 span^2 [-]."""
    drag_coefficient: float = Field(5.46, ge=0)
    """Drag coefficient for the motion relative to the stream [-]. If it depends on the
    Keulegan-Carpenter number, this is its value at 5."""
    drag_exponent: float = Field(0.0, ge=0, le=1)
    """Exponent p of the drag coefficient, which is proportional to (Keulegan-Carpenter number)^-p
    [-]. 0 for constant drag, 1/3 for thin plates (Graham 1980)."""
    friction_coefficient: float = Field(1.328, ge=0)
    """Coefficient of Blasius's skin friction on each face, C / sqrt(Reynolds number of the length)
    [-]."""
    tip_coefficient: float = Field(1.0, ge=0)
    """Factor of the elongated-body tip term [-]; 0 to omit it."""
    wake_memory_s: float = Field(1.0, gt=0)
    """Time over which strokes are averaged [s]; used only if the drag coefficient is not
    constant."""
    stream_mass_kg: float = Field(2.17, ge=0.2)
    """Mass of the water that takes up the momentum of the fin [kg]; the default is a cube of about
    0.13 m. Below 0.2 kg, the stream would change too fast for its time step of one tick."""
    stream_decay_s: float = Field(0.241, ge=0)
    """Time constant of the decay of the stream [s]; 0 for still water."""


REFERENCE_STROKE = 5.0
"""Keulegan-Carpenter number at which the drag coefficient is defined [-]."""

MIN_STROKE = 0.5
"""Keulegan-Carpenter number below which the drag coefficient does not increase any more [-]."""

SLOWEST_FRICTION_M_S = 0.01
"""Speed below which skin friction becomes linear [m/s], so that its slope at rest is finite."""

GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
"""Gauss points along a plate [-]. Two points integrate drag accurately if both ends of the plate
move to the same side."""


class Flow(NamedTuple):
    """Motion of the water caused by the fin."""

    stream: PlanarVector
    """Velocity of the water around the fin, (x, y) [m/s]."""
    excursion: PerPlate
    """Recent displacement of the middle of each plate along its normal [m]."""
    square: PerPlate
    """Recent mean square of the excursion [m2]."""


class Water(eqx.Module):
    """Parameters of the water's loads on each plate, as arrays."""

    plate_length: Scalar
    temperature: Scalar
    """Temperature of the water [degrees Celsius]."""
    inertia: Moments
    """Added mass of each plate [kg, kg m, kg m2]."""
    drag: Float[Array, "2 plates"]
    """Normal force per length divided by velocity squared, at two points of each plate [kg/m2]."""
    friction: PerPlate
    """Tangential force per length divided by velocity^(3/2) [kg/m2 (m/s)^(1/2)]."""
    tip: PerPlate
    """Added mass per length at the outer end of the last plate, where water leaves the fin [kg/m];
    zero for all other plates."""
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
        # Added mass per length of a thin plate of span b: C_a rho pi/4 b^2.
        section = float(config.added_mass_coefficient * rho * np.pi / 4)
        zeroth, first, second = plate_moments(fin, lambda s: section * fin.span(s) ** 2)
        span = fin.span(inner + plate / 2)
        self.plate_length = jnp.asarray(plate, float)
        self.temperature = jnp.asarray(config.temperature_c, float)
        self.inertia = Moments(zeroth, first, second, jnp.zeros_like(zeroth))
        self.drag = jnp.asarray(
            0.5 * rho * config.drag_coefficient * fin.span(inner + plate * GAUSS[:, None])
        )
        # Blasius: C_f / sqrt(u L / nu) * rho/2 u^2 on each of two faces, without u^(3/2).
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
        """Return water of a different temperature [degrees Celsius], with its loads multiplied by
        the factors `added_mass` (also used for the tip term) and `drag`."""
        # All loads are proportional to the density, and friction also to sqrt(viscosity).
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
        """Return the surroundings of the fin for a flow."""
        # The Keulegan-Carpenter number of a sinusoid is 2 pi amplitude / span, and its mean square
        # is amplitude^2 / 2. C = C_d (k / 5)^-p with k = sqrt(KC^2 + 0.5^2).
        number = (
            jnp.sqrt(8 * jnp.pi**2 * flow.square / self.span**2 + MIN_STROKE**2) / REFERENCE_STROKE
        )
        drag = self.drag * number**-self.drag_exponent
        return Surroundings(self.inertia, flow.stream, lambda motion: self._loads(motion, drag))

    def stirred(self, flow: Flow, motion: PlateMotion, force: PlanarVector) -> Flow:
        """Return the flow one tick later.

        Args:
            flow: The flow.
            motion: Motion of the plates relative to the flow.
            force: Mean force of the loads on the fin over the tick [N].
        """
        # M V' = -F - M V / T, solved exactly for a constant force over a tick.
        share = remaining(self.stream_decay)
        stream = share * flow.stream - (1 - share) * self.stream_decay / self.stream_mass * force
        # X <- e X + w dt at the middle of the plate, S <- e S + (1 - e) X^2.
        share = remaining(self.wake_memory)
        excursion = share * flow.excursion + TICK_S * (
            motion.normal + self.plate_length / 2 * motion.turning
        )
        return Flow(stream, excursion, share * flow.square + (1 - share) * excursion**2)

    def _loads(
        self, motion: PlateMotion, drag: Float[Array, "2 plates"]
    ) -> tuple[Moments, PlateWrench]:
        """Return the resistance to the motion relative to the stream [kg/s] and the suction at the
        tip [N]."""
        length = self.plate_length
        # The drag per length, 1/2 rho C b |w| w, is written as a resistance times w, so that the
        # implicit time step can solve for w with |w| fixed. Each Gauss point has half the length.
        places = [length * place for place in GAUSS.tolist()]
        drags = [
            d * length / 2 * jnp.abs(motion.normal + s * motion.turning)
            for d, s in zip(drag, places, strict=True)
        ]
        # The tip force is m w min(u, 0) n - m w^2/2 d. For u > 0 the first term is zero, because
        # water at rest carries no momentum. The tip therefore never adds energy to the fin: the
        # power of the force is -m w^2 |u|/2.
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
    """Return the density of fresh water at 1 atm and 0 to 40 degrees Celsius [kg/m3] (Tanaka et al.
    2001, Metrologia 38, 301)."""
    t = temperature_c
    return 999.974950 * (1 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))


def _viscosity(temperature_c: Scalar | float) -> Scalar | float:
    """Return the kinematic viscosity of fresh water [m2/s] (Vogel's equation)."""
    return 2.414e-5 * 10 ** (247.8 / (temperature_c + 133.15)) / _density(temperature_c)
