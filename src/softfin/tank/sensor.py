"""The force sensor under the fin, modelled after an ATI Axia80-M20: true force in, readings at
100 Hz out.

The model applies, in this order: low-pass filter, misalignment, slow drift (Ornstein-Uhlenbeck),
white noise, resolution and range. Before each experiment, the sensor is zeroed while the fin is at
rest and the true force is zero. The defaults are assumed and correct only in order of magnitude;
`IDEAL` disables all of them. The drive and the water also use the helper functions of this module.
"""

import math
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
"""Minimum time constant in computations [s]; keeps derivatives finite if a time constant is 0."""


def config_arrays(config: Configuration, without: Collection[str] = ()) -> Iterator[Scalar]:
    """Return the numbers of a configuration as arrays, in the order of its fields."""
    return (
        jnp.asarray(value, float)
        for name, value in config.model_dump().items()
        if name not in without
    )


def remaining(time_constant: Scalar) -> Scalar:
    """Return the fraction of a deviation that remains after a tick, exp(-10 ms / time constant); 0
    if the time constant [s] is 0."""
    return jnp.exp(-TICK_S / jnp.maximum(time_constant, MIN_TIME_CONSTANT_S))


def to_multiple(value: Float[Array, "*shape"], step: Scalar) -> Float[Array, "*shape"]:
    """Return the nearest multiple of `step`, or `value` itself if the step is 0; the derivative is
    1 in both cases."""
    # The inner `where` avoids a division by 0, whose NaN would reach the gradient even if not
    # selected. The last line is a straight-through estimator.
    positive = jnp.where(step > 0, step, 1.0)
    rounded = jnp.where(step > 0, jnp.round(value / positive) * positive, value)
    return value + jax.lax.stop_gradient(rounded - value)


def mean_of_past(duration: Scalar) -> tuple[Scalar, Scalar]:
    """Return the distribution of an Ornstein-Uhlenbeck process's mean over its past.

    The process has variance 1, and the mean is taken over the last `duration` (a, in time
    constants). Given the current value x, the mean is normally distributed around c x with variance
    V - c^2, where c = (1 - exp(-a)) / a, and V = 2 (a - 1 + exp(-a)) / a^2 is the unconditional
    variance.

    Returns:
        c and V - c^2.
    """
    # The terms cancel for small a. There, the series in a is accurate to 1e-4 of V - c^2 in single
    # precision.
    is_short = duration < 0.1
    a = jnp.where(is_short, 1.0, duration)
    decay = -jnp.expm1(-a)
    series = duration * (2 / 3 - duration / 2 + 7 / 30 * duration**2)
    slope = jnp.where(is_short, 1 - duration / 2 + duration**2 / 6, decay / a)
    return slope, jnp.where(is_short, series, (2 * (a - decay) - decay**2) / a**2)


class SensorConfig(Configuration):
    """Errors of the sensor; a value of 0 disables an error."""

    filter_s: float = Field(0.01, ge=0)
    """Time constant of the low-pass filter [s]; 0.01 s corresponds to 16 Hz."""
    misalignment_rad: float = Field(0.0, ge=-np.pi, le=np.pi)
    """Angle from the tank axes to the sensor axes [rad]; positive from x to y."""
    noise_n: float = Field(0.05, ge=0)
    """Standard deviation of the white noise on each axis [N]; the default is 1e-4 of the range."""
    drift_n: float = Field(0.05, ge=0)
    """Standard deviation of the drift on each axis [N]."""
    drift_s: float = Field(300.0, gt=0)
    """Time constant of the drift [s]."""
    resolution_n: float = Field(0.02, ge=0)
    """Resolution of readings before the zero is subtracted [N]."""
    range_n: float = Field(500.0, ge=0)
    """Magnitude at which each axis saturates before the zero is subtracted [N]."""
    zero_s: float = Field(2.0, ge=0)
    """Duration of the rest period whose mean reading becomes the zero [s]; 0 for no zeroing."""


IDEAL = SensorConfig(filter_s=0.0, noise_n=0.0, drift_n=0.0, resolution_n=0.0, range_n=0.0)
"""A sensor that reports the true force, averaged over each sample."""


class SensorState(NamedTuple):
    """State of the sensor."""

    filtered: PlanarVector
    """Output of the low-pass filter, (x, y) [N]."""
    drift: PlanarVector
    """Drift since the sensor was installed, (x, y) [N]."""
    zero: PlanarVector
    """Mean reading at rest before the experiment, (x, y) [N]; subtracted from every reading."""


class Sensor(eqx.Module):
    """Parameters of the sensor, as arrays."""

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

    def mean_noise(self, samples: int, seconds: float) -> float:
        """Return the standard deviation of the mean of `samples` readings, `seconds` after zeroing
        [N].

        White noise averages out. The drift d is slower than the mean, and only its change since
        zeroing counts: var(d(t) - d(0)) = 2 drift^2 (1 - exp(-t / drift_time)).
        """
        noise = float(self.noise)
        drift = float(self.drift)
        variance = noise**2 / samples
        if self.zero_time > 0:
            variance += noise**2 / max(float(self.zero_time) / TICK_S, 1.0)
            variance -= 2 * drift**2 * math.expm1(-seconds / float(self.drift_time))
        else:
            variance += drift**2
        return math.sqrt(variance)

    def rest(self, key: PRNGKeyArray) -> SensorState:
        """Return the state at rest after zeroing, with a drift sampled from its stationary
        distribution.

        The zero is the mean reading over the last T seconds. It is sampled as the mean drift, which
        depends on the current drift (`mean_of_past`), plus the mean of T / TICK_S samples of white
        noise.
        """
        drift = self.drift * jax.random.normal(key, (2,), self.drift.dtype)
        samples = jnp.maximum(self.zero_time / TICK_S, 1.0)
        slope, spread = mean_of_past(self.zero_time / self.drift_time)
        variance = self.noise**2 / samples + spread * self.drift**2
        # Noise and drift may both be 0, where the square root has no derivative.
        deviation = jnp.where(variance > 0, jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
        zero = slope * drift + deviation * jax.random.normal(
            jax.random.fold_in(key, 1), (2,), self.drift.dtype
        )
        return SensorState(jnp.zeros_like(drift), drift, jnp.where(self.zero_time > 0, zero, 0.0))

    def read(
        self, state: SensorState, force: PlanarVector, key: PRNGKeyArray
    ) -> tuple[SensorState, PlanarVector]:
        """Return the reading of a tick with the mean force `force` [N]."""
        white, walk = jax.random.normal(key, (2, 2), force.dtype)
        # The exact response of a first-order filter to a constant force over the tick.
        filtered = force + (state.filtered - force) * remaining(self.filter_time)
        # The exact step of an Ornstein-Uhlenbeck process: its variance stays at drift^2.
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
