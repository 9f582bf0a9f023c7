"""The inverse model of the U-CAT robots: the amplitude of a sine for a mean force.

    |F| = K f^2 (1 - cos A),  K = 8 rho C_d S r_c^2 pi^2,  about the direction of the wanted force

is `forceToAmplitude` of the WrenchDriver in the ROS 1 package ``tut_arrows`` of Tallinn University
of Technology, with its coefficients.
"""

import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration


class InverseConfig(Configuration):
    """Coefficients of the U-CAT robots."""

    density_kg_m3: PositiveFloat = 1000.0
    """Density rho of fresh water [kg/m3]."""
    drag_coefficient: PositiveFloat = 0.15
    """Drag coefficient C_d of the flapping fin."""
    area_m2: PositiveFloat = 0.02
    """Area S of the fin [m2]."""
    arm_m: PositiveFloat = 0.1
    """Distance r_c from the shaft to the fin's centre [m]."""
    amplitude_min_rad: float = Field(default=0.1, ge=0)
    """Smallest amplitude that their driver commands [rad]."""
    amplitude_max_rad: float = Field(default=1.2, gt=0, le=np.pi)
    """Largest amplitude that their driver commands [rad]."""

    @model_validator(mode="after")
    def _ordered(self) -> "InverseConfig":
        if self.amplitude_min_rad > self.amplitude_max_rad:
            raise ValueError(
                "amplitude_min_rad must not be above amplitude_max_rad = "
                f"{self.amplitude_max_rad:g}"
            )
        return self

    @property
    def constant(self) -> float:
        """The model's constant K [N s2]."""
        return (
            8 * self.density_kg_m3 * self.drag_coefficient * self.area_m2 * self.arm_m**2 * np.pi**2
        )


def find_amplitude(
    force_n: Float[np.ndarray, "n"], frequency_hz: float, constant: float
) -> Float[np.ndarray, "n"]:
    """Return the amplitude for the size of each force [rad]; pi if no amplitude is large enough."""
    return np.asarray(np.arccos(np.maximum(1 - force_n / (constant * frequency_hz**2), -1.0)))
