"""Noise of a robot's state estimate, computed with NumPy in trials and with JAX in compiled
programs."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import NonNegativeFloat, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.core.operations import select_operations
from softfin.core.quantities import AnyArray
from softfin.robot.dynamics import BodyState
from softfin.robot.rotation import multiply


class NoiseConfig(Configuration):
    """Noise of the robot's estimated state, normally distributed and independent for each
    component."""

    position_m: NonNegativeFloat = 0.01
    """Standard deviation of each coordinate [m]."""
    attitude_rad: NonNegativeFloat = 0.0087
    """Standard deviation about each axis [rad]; half a degree."""
    velocity_m_s: NonNegativeFloat = 0.01
    """Standard deviation of each velocity [m/s]."""
    rate_rad_s: NonNegativeFloat = 0.01
    """Standard deviation of each angular velocity [rad/s]."""
    memory_s: PositiveFloat = 0.1
    """Correlation time of the noise [s]; estimation errors are not white."""

    def deviations(self) -> Float[np.ndarray, "12"]:
        """Return the standard deviations of position, attitude, velocity and angular velocity."""
        return np.repeat(
            [self.position_m, self.attitude_rad, self.velocity_m_s, self.rate_rad_s], 3
        )

    def decay(self, seconds: float) -> tuple[float, float]:
        """Return the weights of the previous noise and of new noise in a time step [s]."""
        # AR(1) process with constant variance: x' = k x + sqrt(1 - k^2) w.
        kept = math.exp(-seconds / self.memory_s)
        return kept, math.sqrt(1 - kept**2)


def estimated(body: BodyState, noise: Float[AnyArray, "*rows 12"]) -> tuple[Any, Any, Any]:
    """Return position, attitude and twist with noise, for one state or rows of states."""
    half = noise[..., 3:6] / 2
    xp = select_operations(*body, noise).xp
    # Small-angle quaternion (1, phi / 2), normalised below.
    turn = xp.concatenate([xp.ones_like(half[..., :1]), half], axis=-1)
    turn = turn / xp.linalg.norm(turn, axis=-1, keepdims=True)
    attitude = multiply(body.attitude.T, turn.T).T
    return body.position + noise[..., :3], attitude, body.twist + noise[..., 6:]
