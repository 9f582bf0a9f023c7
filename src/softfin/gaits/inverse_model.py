"""The inverse model of the U-CAT robots: the amplitude of a sinusoid for a target mean force.

    |F| = K f^2 (1 - cos A),  K = 8 rho C_d S r_c^2 pi^2

The sinusoid is centred on the direction of the target force. The equation and its coefficients are
those of `forceToAmplitude` in the WrenchDriver of the ROS 1 package ``tut_arrows`` (Tallinn
University of Technology).
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
    """Distance r_c from the shaft to the centre of the fin [m]."""
    amplitude_min_rad: float = Field(default=0.1, ge=0)
    """Minimum amplitude that the WrenchDriver commands [rad]."""
    amplitude_max_rad: float = Field(default=1.2, gt=0, le=np.pi)
    """Maximum amplitude that the WrenchDriver commands [rad]."""

    @model_validator(mode="after")
    def _ordered(self) -> "InverseConfig":
        if self.amplitude_min_rad > self.amplitude_max_rad:
            raise ValueError(
                "amplitude_min_rad must not be greater than amplitude_max_rad = "
                f"{self.amplitude_max_rad:g}"
            )
        return self

    @property
    def constant(self) -> float:
        """Constant K of the model [N s2]."""
        return (
            8 * self.density_kg_m3 * self.drag_coefficient * self.area_m2 * self.arm_m**2 * np.pi**2
        )


def find_amplitude(
    force_n: Float[np.ndarray, "n"], frequency_hz: float, constant: float
) -> Float[np.ndarray, "n"]:
    """Return the amplitude for each force magnitude [rad]; pi if no amplitude is large enough."""
    # A = arccos(1 - |F| / (K f^2)); the largest possible force is 2 K f^2.
    return np.asarray(np.arccos(np.maximum(1 - force_n / (constant * frequency_hz**2), -1.0)))
