"""Time offsets between command, angle and force: which follows which, and by how many milliseconds.

The angle is the reference. A command appears in the angle's rate after the drive's dead time; the
force follows the angle's rate and acceleration, after the fin has bent and the sensor has filtered.

The axes of the force are found by comparing what a fin must do with every way to swap or reverse
the measured axes: thrust points along (cos theta, -sin theta) and grows with the square of the
rate; added mass and drag act across it, along (sin theta, cos theta), against acceleration and
rate. No term may change its sign, so a reversed axis is visible.
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.data.importing.importing import FORCE_FRAMES, turned

LogSeries: TypeAlias = Float[np.ndarray, "ticks"]
"""Values of a channel at 100 Hz."""

SEARCHED_TICKS = 20
"""Largest lag that is searched, in either direction."""

RESPONSE_TICKS = np.arange(-2 * SEARCHED_TICKS, 4 * SEARCHED_TICKS)
"""Ticks around a step of the command in which its response is searched."""

FOLLOWING_TICKS = 15
"""Number of ticks after which an angle moves in the direction of its command."""

MIN_ALIGNED_S = 10
"""Length of a recording from which the force's lag and axes are computed [s]."""


def measure_rate(values: LogSeries) -> LogSeries:
    """Rate of change per second, smoothed over 50 ms."""
    return np.asarray(np.gradient(smoothed(values), TICK_S))


def smoothed(values: LogSeries) -> LogSeries:
    """Smooth by a Hann window of five samples, which adds no delay."""
    kernel = np.hanning(7)[1:-1] / np.hanning(7).sum()
    return np.convolve(np.pad(values, 2, mode="edge"), kernel, "valid")


def command_lag(command: LogSeries, angle: LogSeries) -> float | None:
    """Compute the lag from a command to the angle [ms]: the time at which the median response to
    its steps rises.

    The median weighs all steps alike, so the occasional jump of an encoder does not matter. None if
    there are fewer than 50 steps.
    """
    steps = np.flatnonzero(np.abs(np.diff(command, prepend=command[0])) > 1e-4)
    steps = steps[(steps >= -RESPONSE_TICKS[0]) & (steps < len(angle) - RESPONSE_TICKS[-1])]
    if not 50 <= len(steps) <= 0.5 * len(command):
        return None
    mirrored = np.cov(command[:-FOLLOWING_TICKS], angle[FOLLOWING_TICKS:])[0, 1] < 0
    # Towards the new target; a slow drive may already be moving towards it.
    side = np.sign((-command if mirrored else command) - angle)[steps]
    response = np.median(
        side[:, None] * np.gradient(angle)[steps[:, None] + RESPONSE_TICKS], axis=0
    )
    # The drive has begun to obey when a fifth of the peak is reached.
    onset = 0.2 * response.max()
    below = np.flatnonzero(response[: response.argmax()] < onset)
    if not below.size:
        return None
    low, high = response[below[-1] : below[-1] + 2]
    place = RESPONSE_TICKS[below[-1]] + (onset - low) / (high - low)
    return float(place * TICK_S * 1e3)


def force_lag(angle: LogSeries, force: Float[np.ndarray, "ticks 2"]) -> float | None:
    """Compute the lag at which a linear model of the motion explains most of the force [ms],
    whatever its axes.

    None if the recording is too short, the best lag is at the end of the searched range, or the
    motion explains less than a tenth of the force.
    """
    ticks = SEARCHED_TICKS
    if len(angle) < MIN_ALIGNED_S * RATE_HZ:
        return None
    _, along, rate, acceleration = _motion(angle)
    # Added mass, drag, thrust and damping, along both axes as the fin turns.
    terms = [acceleration, rate * np.abs(rate), rate**2, rate, np.ones_like(rate)]
    features = np.stack([term * axis for axis in along for term in terms], axis=1)[ticks:-ticks]
    features = features - features.mean(axis=0)
    features = features / (features.std(axis=0) + 1e-12)
    # An orthonormal basis of what the features span. The share of a force that they explain is then
    # |basis^T f|^2 / |f|^2, one product for each lag.
    sizes, vectors = np.linalg.eigh(features.T @ features)
    kept = sizes > 1e-9 * sizes[-1]
    basis = features @ (vectors[:, kept] / np.sqrt(sizes[kept]))
    smooth = np.stack([smoothed(axis) for axis in force.T], axis=1)
    explained = np.zeros(2 * ticks + 1)
    for index in range(len(explained)):
        part = smooth[index : index + len(basis)]
        part = part - part.mean(axis=0)
        explained[index] = ((basis.T @ part) ** 2).sum() / ((part**2).sum() + 1e-12)
    best = int(explained.argmax())
    if best in (0, 2 * ticks) or explained[best] < 0.1:
        return None
    # The peak of the parabola through the best lag and its neighbours.
    left, middle, right = explained[best - 1 : best + 2]
    place = best - ticks + (left - right) / 2 / (left - 2 * middle + right)
    return float(place * TICK_S * 1e3)


def frame_correlations(
    angle: LogSeries, force: Float[np.ndarray, "ticks 2"], lag_ms: float | int = 0.0
) -> dict[str, float]:
    """Compute the correlation of the force, read in each of `FORCE_FRAMES`, with the best fit of a
    model fin."""
    across, along, rate, acceleration = _motion(angle)
    # Drag, added mass, and thrust in its quadratic and its linear part.
    terms = [
        -rate * np.abs(rate) * across,
        -acceleration * across,
        rate**2 * along,
        np.abs(rate) * along,
    ]
    # A force that lags by n ticks is compared with the motion n ticks earlier.
    ticks = round(lag_ms * RATE_HZ / 1e3)
    count = len(angle) - abs(ticks)
    model = np.stack(terms, axis=-1)[:, max(-ticks, 0) :][:, :count]
    smooth = np.stack([smoothed(axis) for axis in force.T])[:, max(ticks, 0) :][:, :count]
    model = (model - model.mean(axis=1, keepdims=True)).reshape(-1, len(terms))
    smooth = smooth - smooth.mean(axis=1, keepdims=True)
    model = model / (np.linalg.norm(model, axis=0) + 1e-12)
    smooth = smooth / (np.linalg.norm(smooth) + 1e-12)
    # The fit in the model's four dimensions only.
    basis, model = np.linalg.qr(model)
    correlations = {}
    for frame in FORCE_FRAMES:
        force = basis.T @ np.concatenate(turned(smooth[0], smooth[1], frame))
        # No coefficient may be negative: a reversed axis fits worse.
        coefficients, _ = nnls(model, force)
        correlations[frame] = float(np.linalg.norm(model @ coefficients))
    return correlations


def _motion(
    angle: LogSeries,
) -> tuple[Float[np.ndarray, "2 ticks"], Float[np.ndarray, "2 ticks"], LogSeries, LogSeries]:
    """Directions across the fin and along it, its rate [rad/s] and its acceleration [rad/s^2]."""
    cos = np.cos(smoothed(angle))
    sin = np.sin(smoothed(angle))
    rate = measure_rate(angle)
    return np.stack([sin, cos]), np.stack([cos, -sin]), rate, measure_rate(rate)
