"""Sines of the shaft as commands, and the analytic inverse model by which the U-CAT robots choose them for a force.

The drive runs a velocity profile to its target angle, so the target goes along the sine and the profile velocity, which
is a ceiling, stays at the sine's greatest speed. A ceiling that follows the sine's own speed holds the profile back at
each turn: on the virtual tank a sine of 0.4 rad and 2 Hz then comes out as one of 0.25 rad, and as 0.39 rad this way.

    |F| = K f^2 (1 - cos A),  K = 8 rho C_d S r_c^2 pi^2,  about the direction of the wanted force

is `forceToAmplitude` of the WrenchDriver in the ROS 1 package ``tut_arrows`` of Tallinn University of Technology, with
its coefficients.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field, PositiveFloat, model_validator

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray, Command, Limits

ROUNDING = 1e-6
"""Rounding of single precision about the greatest angles [rad] and velocities [rad/s]."""


class ShaftSine(NamedTuple):
    """angle(t) = centre + amplitude sin(2 pi frequency t)."""

    centre: Float[AnyArray, "*shape"]
    """Angle in the middle [rad]."""
    amplitude: Float[AnyArray, "*shape"]
    """Greatest distance from the middle [rad]."""
    frequency: Float[AnyArray, "*shape"]
    """Periods a second [Hz]."""

    def commands(self, limits: Limits, ticks: int) -> tuple[Command, Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Commands ``(*shape, ticks)`` within the limits, and fractions of ticks of which these clip angle and speed.

        A profile velocity that is raised to the plant's least one clips nothing: the target angle still sets the pace.
        """
        centre, amplitude, frequency = (jnp.asarray(part, jnp.float32)[..., None] for part in self)
        # The command of a tick shows in the reading at its end.
        turn = 2 * jnp.pi * frequency * (jnp.arange(ticks) + 1) * TICK_S
        angle = centre + amplitude * jnp.sin(turn)
        fastest = 2 * jnp.pi * frequency * amplitude
        outside = (angle < limits.angle_min - ROUNDING) | (angle > limits.angle_max + ROUNDING)
        too_fast = fastest * jnp.abs(jnp.cos(turn)) > limits.velocity_max + ROUNDING
        velocity = jnp.broadcast_to(jnp.clip(fastest, limits.velocity_min, limits.velocity_max), angle.shape)
        command = Command(jnp.clip(angle, limits.angle_min, limits.angle_max), velocity)
        return command, outside.mean(axis=-1), too_fast.mean(axis=-1)


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
        """The model's constant K [N s2]."""
        return 8 * self.density_kg_m3 * self.drag_coefficient * self.area_m2 * self.arm_m**2 * np.pi**2


def inverse(
    force: Float[np.ndarray, "forces 2"], frequency: float, limits: Limits, config: InverseConfig, constant: float
) -> tuple[ShaftSine, list[dict[str, Any]]]:
    """The sine that should give each force (x, y) [N] on average; `constant` is K [N s2], the config's or a fitted one.

    Also returns, for JSON, whether the amplitude was clipped to the driver's range (to pi where no amplitude gives as
    much) and the centre to the angles that the plant takes. Thrust at angle theta points along (cos theta, -sin theta),
    so a force towards -y is made at a positive angle.
    """
    wanted = np.arctan2(-force[:, 1], force[:, 0])
    centre = np.clip(wanted, limits.angle_min, limits.angle_max)
    exact = np.arccos(np.maximum(1 - np.linalg.norm(force, axis=1) / (constant * frequency**2), -1.0))
    amplitude = np.clip(exact, config.amplitude_min_rad, config.amplitude_max_rad)
    limited = [
        {"amplitude_limited": bool(size), "direction_limited": bool(direction), "constant_n_s2": constant}
        for size, direction in zip(amplitude != exact, centre != wanted, strict=True)
    ]
    return ShaftSine(centre, amplitude, np.full_like(amplitude, frequency)), limited
