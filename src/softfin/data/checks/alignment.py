"""Time offsets between command, angle and force: what follows what, and by how many milliseconds.

The angle is the reference. A command appears in the angle's rate after the drive's dead time; the force follows the
angle's rate and acceleration, after the fin has bent and the sensor has filtered.

Which way the force's axes lie is found by comparing what a fin must do with every way to swap and turn the measured
axes: thrust points along (cos theta, -sin theta) and grows with the square of the rate; added mass and drag act across
it, along (sin theta, cos theta), against acceleration and rate. No term may change its sign, so a turned axis shows.
"""

import itertools
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.data.importing.importing import FORCE_FRAMES

Series: TypeAlias = Float[np.ndarray, "ticks"]
"""Values of a channel at 100 Hz."""

COMMAND_LAG_MS = (0.0, 100.0)
"""Plausible lag from a command to the angle: the way through computer, bus and drive; about 27 ms in the virtual tank,
10 ms in the published fin."""

FORCE_LAG_MS = (0.0, 60.0)
"""Plausible lag from the angle to the force: 20 ms in the virtual tank, 45 ms in the published fin."""

SEARCHED_TICKS = 20
"""Largest lag that is searched, either way."""

OFFSETS = np.arange(-2 * SEARCHED_TICKS, 4 * SEARCHED_TICKS)
"""Ticks about a step of the command, in which its response is looked for."""

FOLLOWING_TICKS = 15
"""Number of ticks after which an angle goes the way of its command."""

NEAR_RAD, NEAR_RAD_S = 0.03, 3.0
"""Distance from its target or its velocity at which a drive eases off [rad, rad/s]; those of the tank's drive, and few
others' differ."""

LEAST_MATCH = 0.5
"""Correlation from which a drive is taken to follow a profile: 0.6 to 0.9 in the tank, 0.35 in the published fin."""

ONSET = 0.25
"""Fraction of the response's peak at which the drive has begun to obey."""

LEAST_STEPS = 50
"""Number of commands from which a lag is computed."""

SHORTEST_S = 10
"""Length of a recording from which the force's lag and axes are computed [s]."""

LEAST_EXPLAINED = 0.1
"""Fraction of the force that the angle must explain for a lag."""


class MotionSignals(NamedTuple):
    """Angle, velocity and acceleration of a shaft, smoothed over 50 ms."""

    angle: Series
    velocity: Series
    acceleration: Series


class Lag(NamedTuple):
    """Lag of one channel behind another."""

    milliseconds: float
    strength: float
    """Correlation with a profile, or the response's peak over the rate's deviation, or the fraction explained."""


def motion(angle: Series) -> MotionSignals:
    """Differentiate an angle at 100 Hz [rad]."""
    smooth = smoothed(angle)
    velocity = np.gradient(smooth, TICK_S)
    return MotionSignals(smooth, velocity, np.gradient(smoothed(velocity), TICK_S))


def smoothed(values: Series) -> Series:
    """Smooth by a Hann window of five samples, which delays nothing."""
    kernel = np.hanning(7)[1:-1] / np.hanning(7).sum()
    return np.convolve(np.pad(values, 2, mode="edge"), kernel, "valid")


def command_lag(command: Series, speed: Series, angle: Series) -> Lag | None:
    """Compute the lag from a command, its angle [rad] and velocity [rad/s], to the angle; None where it is not certain.

    `_profile_lag` finds when a drive that follows a profile obeys; where the fin moves by no profile, the rise of its
    response to the commands' steps counts.
    """
    change = np.diff(command, prepend=command[0])
    steps = np.flatnonzero(np.abs(change) > 1e-4)
    steps = steps[(steps >= 2 * SEARCHED_TICKS) & (steps < len(angle) - 4 * SEARCHED_TICKS)]
    if len(steps) < LEAST_STEPS or len(steps) > 0.5 * len(command):
        return None
    mirrored = np.corrcoef(command[:-FOLLOWING_TICKS], angle[FOLLOWING_TICKS:])[0, 1] < 0
    lag = _profile_lag(-command if mirrored else command, speed, angle)
    return _stepping_lag(np.sign(change), steps, angle) if lag is None else lag


def _profile_lag(command: Series, speed: Series, angle: Series) -> Lag | None:
    """Find the lag at which the rate changes towards what the command asks for: its speed, until the target is near."""
    rate = np.gradient(angle, TICK_S)
    inner = slice(SEARCHED_TICKS, len(angle) - SEARCHED_TICKS)
    gain = (np.roll(rate, -1) - np.roll(rate, 1))[inner]
    before = np.roll(rate, 1)[inner]
    matches = np.zeros(2 * SEARCHED_TICKS + 1)
    for index in range(len(matches)):
        rows = slice(2 * SEARCHED_TICKS - index, len(angle) - index)
        asked = np.tanh((command[rows] - angle[inner]) / NEAR_RAD) * speed[rows]
        wanted = np.tanh((asked - before) / NEAR_RAD_S)
        if wanted.std() > 0 and gain.std() > 0:
            matches[index] = np.corrcoef(wanted, gain)[0, 1]
    return _peak_lag(matches, LEAST_MATCH)


def _stepping_lag(side: Series, steps: Int[np.ndarray, "steps"], angle: Series) -> Lag | None:
    """Find the rise of the response to steps: its peak comes while the fin is still on its way."""
    rate = motion(angle).velocity
    # The median, where every step weighs alike: an encoder that jumps now and then makes no response of its own.
    rise = np.median(side[steps][:, None] * rate[steps[:, None] + OFFSETS], axis=0)
    rise = rise - np.median(rise[:SEARCHED_TICKS])
    response = rise * np.sign(rise[np.abs(rise).argmax()])
    peak = int(response.argmax())
    below = np.flatnonzero(response[:peak] < ONSET * response[peak])
    if not below.size:
        return None
    low, high = response[below[-1] : below[-1] + 2]
    place = OFFSETS[below[-1]] + (ONSET * response[peak] - low) / (high - low)
    return Lag(float(place / RATE_HZ * 1e3), float(response[peak] / (rate.std() + 1e-12)))


def force_lag(angle: Series, force: Float[np.ndarray, "ticks 2"]) -> Lag | None:
    """Compute the lag at which a linear model of the motion explains most of the force, whatever its axes and signs.

    None where the recording is too short or the best lag lies at the end of those that were searched.
    """
    ticks = SEARCHED_TICKS
    if len(angle) < SHORTEST_S * RATE_HZ:
        return None
    features = _features(motion(angle))[ticks:-ticks]
    features = features - features.mean(axis=0)
    scale = features.std(axis=0)
    features = features / np.where(scale > 0, scale, 1.0)
    inverse = np.linalg.pinv(features.T @ features, rcond=1e-9, hermitian=True)
    series = np.stack([smoothed(force[:, 0]), smoothed(force[:, 1])], axis=1)
    explained = np.zeros(2 * ticks + 1)
    for index in range(len(explained)):
        centred = series[index : index + len(features)]
        centred = centred - centred.mean(axis=0)
        product = features.T @ centred
        explained[index] = (product * (inverse @ product)).sum() / ((centred**2).sum() + 1e-12)
    return _peak_lag(explained, LEAST_EXPLAINED)


def _peak_lag(values: Float[np.ndarray, "lags"], least: float) -> Lag | None:
    """Find the lag of the greatest value, by the parabola through it and its neighbours; None at an end or too low."""
    best = int(values.argmax())
    if best in (0, len(values) - 1) or values[best] < least:
        return None
    left, middle, right = values[best - 1 : best + 2]
    bend = left - 2 * middle + right
    place = best - SEARCHED_TICKS + (0.0 if bend == 0 else (left - right) / 2 / bend)
    return Lag(float(place / RATE_HZ * 1e3), float(values[best]))


def _features(moving: MotionSignals) -> Float[np.ndarray, "ticks 10"]:
    """Added mass, drag, thrust and damping, along both axes as the fin turns."""
    angle, velocity, acceleration = moving
    terms = np.stack([acceleration, velocity * np.abs(velocity), velocity**2, velocity, np.ones_like(angle)], axis=1)
    return np.concatenate([terms * np.cos(angle)[:, None], terms * np.sin(angle)[:, None]], axis=1)


def frame_correlations(
    angle: Series, force: Float[np.ndarray, "ticks 2"], lag_ms: float | int = 0.0
) -> dict[str, float]:
    """Compute the correlation of the force, taken in each of `FORCE_FRAMES`, with the best fit of a model fin."""
    ticks = round(lag_ms * RATE_HZ / 1e3)
    terms = _model_terms(angle)
    smooth = np.stack([smoothed(force[:, 0]), smoothed(force[:, 1])])
    count = len(angle) - abs(ticks)
    terms = terms[:, max(-ticks, 0) :][:, :count]
    smooth = smooth[:, max(ticks, 0) :][:, :count]
    terms = terms - terms.mean(axis=1, keepdims=True)
    smooth = smooth - smooth.mean(axis=1, keepdims=True)
    # Axis by axis: every frame is made of these products, so that the rows are gone through once.
    products = np.einsum("xtk,yt->xyk", terms, smooth)
    scale = np.sqrt((terms**2).sum(axis=(0, 1))) + 1e-12
    gram = np.einsum("xtk,xtl->kl", terms, terms) / np.outer(scale, scale)
    norm = float(np.sqrt((smooth**2).sum())) + 1e-12
    result = {}
    for frame in FORCE_FRAMES:
        signs = [(-1.0 if part.startswith("-") else 1.0, "xy".index(part[-1])) for part in frame.split(",")]
        product = sum(sign * products[axis, source] for axis, (sign, source) in enumerate(signs)) / scale
        result[frame] = _best(gram, np.asarray(product)) / norm
    return result


def _model_terms(angle: Series) -> Float[np.ndarray, "2 ticks terms"]:
    theta, rate, acceleration = motion(angle)
    cos, sin = np.cos(theta), np.sin(theta)
    across, along = np.stack([sin, cos]), np.stack([cos, -sin])
    columns = [-rate * np.abs(rate) * across, -acceleration * across, rate**2 * along, np.abs(rate) * along]
    return np.stack(columns, axis=-1)


def _best(gram: Float[np.ndarray, "terms terms"], product: Float[np.ndarray, "terms"]) -> float:
    """Norm of the least-squares fit whose coefficients are none below 0; so few terms that every choice is tried."""
    best = 0.0
    for chosen in itertools.chain.from_iterable(itertools.combinations(range(len(gram)), n) for n in (1, 2, 3, 4)):
        index = list(chosen)
        weights = np.linalg.lstsq(gram[np.ix_(index, index)], product[index], rcond=1e-9)[0]
        if (weights >= 0).all():
            best = max(best, float(weights @ product[index]))
    return float(np.sqrt(best))
