"""The analytic inverse model that the U-CAT robots steer their fins by: wanted force in, sine of the shaft out.

    |F| = K f^2 (1 - cos A),  K = 8 rho C_d S r_c^2 pi^2,  beating about the direction that the force is wanted along

It is `forceToAmplitude` of the WrenchDriver in the ROS 1 package ``tut_arrows`` of Tallinn University of Technology,
with its coefficients.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import RunError
from softfin.core.quantities import Limits
from softfin.evaluation.baselines.sine import Sine


class InverseConfig(Configuration):
    """Coefficients of the U-CAT robots."""

    density_kg_m3: PositiveFloat = 1000.0
    """rho, of fresh water [kg/m3]."""
    drag_coefficient: PositiveFloat = 0.15
    """C_d of the beating fin."""
    area_m2: PositiveFloat = 0.02
    """S, of the fin [m2]."""
    arm_m: PositiveFloat = 0.1
    """r_c, from the shaft to the fin's centre [m]."""
    amplitude_min_rad: float = Field(default=0.1, ge=0)
    """Least amplitude that their driver asks for [rad]."""
    amplitude_max_rad: float = Field(default=1.2, gt=0, le=np.pi)
    """Greatest amplitude that their driver asks for [rad]."""

    @model_validator(mode="after")
    def _ordered(self) -> "InverseConfig":
        if self.amplitude_min_rad > self.amplitude_max_rad:
            raise ValueError(f"amplitude_min_rad must not be above amplitude_max_rad = {self.amplitude_max_rad:g}")
        return self

    @property
    def constant(self) -> float:
        """K [N s2]."""
        return 8 * self.density_kg_m3 * self.drag_coefficient * self.area_m2 * self.arm_m**2 * np.pi**2


class Inverted(NamedTuple):
    """The beats for some forces, and which of them the model could not have as it wanted."""

    sine: Sine
    """Fields ``(forces,)``."""
    amplitude_clipped: Bool[np.ndarray, "forces"]
    """To the driver's range of amplitudes."""
    direction_clipped: Bool[np.ndarray, "forces"]
    """To the angles that the plant takes."""


def inverse(
    force: Float[np.ndarray, "forces 2"], frequency: float, limits: Limits, config: InverseConfig, constant: float
) -> Inverted:
    """The sine that should give each force (x, y) [N] on average; `constant` is K [N s2], the config's or a fitted one.

    Thrust at angle theta points along (cos theta, -sin theta), so a force towards -y is made at a positive angle.
    """
    wanted = np.arctan2(-force[:, 1], force[:, 0])
    centre = np.clip(wanted, limits.angle_min, limits.angle_max)
    exact = amplitude(np.hypot(force[:, 0], force[:, 1]), frequency, constant)
    held = np.clip(exact, config.amplitude_min_rad, config.amplitude_max_rad)
    return Inverted(Sine(centre, held, np.full_like(held, frequency)), held != exact, centre != wanted)


def amplitude(force: Float[np.ndarray, "*shape"], frequency: float, constant: float) -> Float[np.ndarray, "*shape"]:
    """A for the size of a force [N]; pi where no amplitude gives as much."""
    return np.asarray(np.arccos(np.maximum(1 - force / (constant * frequency**2), -1.0)))


def mean_force(
    amplitude: Float[np.ndarray, "*shape"], frequency: float, constant: float
) -> Float[np.ndarray, "*shape"]:
    """What the model says of a sine [N]."""
    return np.asarray(constant * frequency**2 * (1 - np.cos(amplitude)))


def recalibrated(amplitude: Float[np.ndarray, "trials"], frequency: float, force: Float[np.ndarray, "trials"]) -> float:
    """K by least squares from trials at one frequency: mean forces [N] along the zero direction.

    Raises:
        RunError: the fin pulls instead of pushing, so that no K fits.
    """
    unit = mean_force(amplitude, frequency, 1.0)
    constant = float(unit @ force / (unit @ unit))
    if not constant > 0:
        raise RunError(
            f"inverse model at {frequency:g} Hz: the trials' mean force is {force.mean():.3g} N, against the zero "
            "direction; the model knows fins that push along it alone; give another frequency"
        )
    return constant
