"""The force sensor under the fin, modelled on an ATI Axia80-M20: the true force goes in, its
readings at 100 Hz come out.

Low-pass filter, mounting misalignment, slow drift (Ornstein-Uhlenbeck), white noise, resolution,
range, in this order. Before each experiment the sensor is zeroed while the fin rests, when the true
force is known to be zero. The numbers are assumptions of the right order of magnitude, not from a
datasheet; `IDEAL` turns them all off. Drive and water share the sampling functions of this module:
relaxation within a sample, and rounding to a resolution.
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
from softfin.tank.chain import PlanarVector, Scalar

MIN_TIME_CONSTANT_S = 1e-6
"""Shortest time constant [s] in computations; it keeps derivatives finite where one is zero."""


def config_arrays(config: Configuration, without: Collection[str] = ()) -> Iterator[Scalar]:
    """Yield the numbers of a configuration as arrays, in the order of its fields."""
    return (
        jnp.asarray(value, float)
        for name, value in config.model_dump().items()
        if name not in without
    )


def remaining(time_constant: Scalar) -> Scalar:
    """Return the fraction of a deviation that remains after a sample of 10 ms; 0 if the time
    constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, MIN_TIME_CONSTANT_S))


def to_multiple(value: Float[Array, "*shape"], step: Scalar) -> Float[Array, "*shape"]:
    """Return the nearest multiple of `step`, or `value` itself if the step is 0; its derivative is
    1 in both cases."""
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)


def mean_of_past(duration: Scalar) -> tuple[Scalar, Scalar]:
    """Return how the mean of an Ornstein-Uhlenbeck process over its last a time constants depends
    on its present value.

    The process has variance 1. Given the value x, the mean is normally distributed around c x, with
    c = (1 - exp(-a)) / a, with variance V - c^2, where V = 2 (a - 1 + exp(-a)) / a^2 is the
    variance of the mean for any x. Returns c and V - c^2.
    """
    # Terms cancel if a is small; there the series in a is exact to 1e-4 of V - c^2 in single
    # precision.
    is_short = duration < 0.1
    a = jnp.where(is_short, 1.0, duration)
    decay = -jnp.expm1(-a)
    series = duration * (2 / 3 - duration / 2 + 7 / 30 * duration**2)
    slope = jnp.where(is_short, 1 - duration / 2 + duration**2 / 6, decay / a)
    return slope, jnp.where(is_short, series, (2 * (a - decay) - decay**2) / a**2)


class SensorConfig(Configuration):
    """Imperfections of the sensor; 0 turns one off."""

    filter_s: float = Field(0.01, ge=0)
    """Time constant of the low-pass filter [s]: 16 Hz."""
    misalignment_rad: float = Field(0.0, ge=-np.pi, le=np.pi)
    """Angle from the tank's axes to the sensor's [rad], from x to y."""
    noise_n: float = Field(0.05, ge=0)
    """Standard deviation of the white noise on each axis [N]: 1e-4 of the range of 500 N."""
    drift_n: float = Field(0.05, ge=0)
    """Standard deviation of the drift on each axis [N]."""
    drift_s: float = Field(300.0, gt=0)
    """Time constant of the drift [s]."""
    resolution_n: float = Field(0.02, ge=0)
    """Readings are multiples of this before the zero is subtracted [N]."""
    range_n: float = Field(500.0, ge=0)
    """Readings saturate at this magnitude before the zero is subtracted, on each axis [N]."""
    zero_s: float = Field(2.0, ge=0)
    """Time at rest whose mean reading becomes the zero before each experiment [s]; 0: not
    zeroed."""


IDEAL = SensorConfig(filter_s=0.0, noise_n=0.0, drift_n=0.0, resolution_n=0.0, range_n=0.0)
"""A sensor that reports the true force, averaged over each sample."""


class SensorState(NamedTuple):
    """State of the sensor, each (x, y) [N]."""

    filtered: PlanarVector
    """Output of the low-pass filter."""
    drift: PlanarVector
    """Drift since the sensor was installed."""
    zero: PlanarVector
    """Mean reading at rest before the experiment; it is subtracted from every reading."""


class Sensor(eqx.Module):
    """Parameters of the sensor as arrays."""

    filter_time: Scalar
    misalignment: Scalar
    noise: Scalar
    drift: Scalar
    drift_time: Scalar
    resolution: Scalar
    range: Scalar
    zero_time: Scalar

    def __init__(self, config: SensorConfig):
        (
            self.filter_time,
            self.misalignment,
            self.noise,
            self.drift,
            self.drift_time,
            self.resolution,
            self.range,
            self.zero_time,
        ) = config_arrays(config)

    def rest(self, key: PRNGKeyArray) -> SensorState:
        """Return the state at rest after zeroing; the drift starts at a value from its stationary
        distribution.

        The zero is the mean reading over the last T seconds: the mean drift, whose relation to the
        present drift `mean_of_past` gives, plus the mean of T / TICK_S samples of white noise.
        """
        drift = self.drift * jax.random.normal(key, (2,), self.drift.dtype)
        samples = jnp.maximum(self.zero_time / TICK_S, 1.0)
        slope, spread = mean_of_past(self.zero_time / self.drift_time)
        variance = self.noise**2 / samples + spread * self.drift**2
        # Noise and drift may both be 0, and the square root has no derivative there.
        deviation = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
        zero = slope * drift + deviation * jax.random.normal(
            jax.random.fold_in(key, 1), (2,), self.drift.dtype
        )
        return SensorState(jnp.zeros_like(drift), drift, jnp.where(self.zero_time > 0, zero, 0.0))

    def read(
        self, state: SensorState, force: PlanarVector, key: PRNGKeyArray
    ) -> tuple[SensorState, PlanarVector]:
        """Read one sample of 10 ms, in which the mean force was `force` [N]."""
        white, walk = jax.random.normal(key, (2, 2), force.dtype)
        filtered = force + (state.filtered - force) * remaining(self.filter_time)
        share = remaining(self.drift_time)
        drift = (
            share * state.drift
            + jnp.sqrt(-jnp.expm1(-2 * TICK_S / self.drift_time)) * self.drift * walk
        )
        cos = jnp.cos(self.misalignment)
        sin = jnp.sin(self.misalignment)
        x, y = filtered
        turned = jnp.stack([cos * x + sin * y, cos * y - sin * x])
        raw = to_multiple(turned + drift + self.noise * white, self.resolution)
        most = jnp.where(self.range > 0, self.range, jnp.inf)
        # The electronics saturate before the zero is subtracted.
        return SensorState(filtered, drift, state.zero), jnp.clip(raw, -most, most) - state.zero
