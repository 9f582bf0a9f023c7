"""The force sensor under the fin, after an ATI Axia80-M20: the true force in, what it reports at 100 Hz out.

Low-pass filter, mounting misalignment, slow drift (Ornstein-Uhlenbeck), white noise, resolution, range, in this order.
The numbers are assumptions of the right order, not a datasheet's; `IDEAL` turns every one of them off. Drive and water
use what is here of sampling: relaxation within a sample, rounding to a resolution.
"""

from collections.abc import Collection, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S

MIN_TIME_CONSTANT_S = 1e-6
"""Shortest time constant [s] in computations; it keeps derivatives finite where one is zero."""


def arrays_of(config: Configuration, without: Collection[str] = ()) -> Iterator[Float[Array, ""]]:
    """Yield the numbers of a configuration as arrays, in the order of its fields."""
    return (jnp.asarray(value, float) for name, value in config.model_dump().items() if name not in without)


def remaining(time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """Return the fraction of a deviation that is left after a sample of 10 ms; 0 where the time constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, MIN_TIME_CONSTANT_S))


def to_multiple(value: Float[Array, "*shape"], step: Float[Array, ""]) -> Float[Array, "*shape"]:
    """Return the nearest multiple of `step`, or `value` itself where the step is 0; its derivative is 1 either way."""
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)


class SensorConfig(Configuration):
    """Imperfections of the sensor; 0 turns one off."""

    filter_s: float = Field(0.01, ge=0)
    """Time constant of the low-pass filter [s]: 16 Hz."""
    misalignment_rad: float = Field(0.0, ge=-np.pi, le=np.pi)
    """Angle of the sensor's axes to the tank's [rad], from x to y."""
    noise_n: float = Field(0.05, ge=0)
    """Standard deviation of the white noise on each axis [N]: 1e-4 of the range of 500 N."""
    drift_n: float = Field(0.05, ge=0)
    """Standard deviation of the drift on each axis [N]."""
    drift_s: float = Field(300.0, gt=0)
    """Time in which the drift forgets itself [s]."""
    resolution_n: float = Field(0.02, ge=0)
    """Readings are multiples of this [N]."""
    range_n: float = Field(500.0, ge=0)
    """Readings end at this, either way, on each axis [N]."""


IDEAL = SensorConfig(filter_s=0.0, noise_n=0.0, drift_n=0.0, resolution_n=0.0, range_n=0.0)
"""Reports the true force, averaged over each sample."""


class SensorState(NamedTuple):
    """Output of the filter and drift, both (x, y) [N]."""

    filtered: Float[Array, "2"]
    drift: Float[Array, "2"]


class Sensor(eqx.Module):
    """Parameters of the sensor as arrays."""

    filter_time: Float[Array, ""]
    misalignment: Float[Array, ""]
    noise: Float[Array, ""]
    drift: Float[Array, ""]
    drift_time: Float[Array, ""]
    resolution: Float[Array, ""]
    range: Float[Array, ""]

    def __init__(self, config: SensorConfig):
        (
            self.filter_time, self.misalignment, self.noise, self.drift, self.drift_time, self.resolution, self.range,
        ) = arrays_of(config)  # fmt: skip

    def rest(self, key: PRNGKeyArray) -> SensorState:
        """Return the state without force yet; the drift is wherever its past has left it."""
        drift = self.drift * jax.random.normal(key, (2,), self.drift.dtype)
        return SensorState(jnp.zeros_like(drift), drift)

    def read(
        self, state: SensorState, force: Float[Array, "2"], key: PRNGKeyArray
    ) -> tuple[SensorState, Float[Array, "2"]]:
        """Read one sample of 10 ms, in which the mean force was `force` [N]."""
        white, walk = jax.random.normal(key, (2, 2), force.dtype)
        filtered = force + (state.filtered - force) * remaining(self.filter_time)
        share = remaining(self.drift_time)
        drift = share * state.drift + jnp.sqrt(-jnp.expm1(-2 * TICK_S / self.drift_time)) * self.drift * walk
        cos, sin = jnp.cos(self.misalignment), jnp.sin(self.misalignment)
        x, y = filtered
        turned = jnp.stack([cos * x + sin * y, cos * y - sin * x])
        reading = to_multiple(turned + drift + self.noise * white, self.resolution)
        most = jnp.where(self.range > 0, self.range, jnp.inf)
        return SensorState(filtered, drift), jnp.clip(reading, -most, most)
