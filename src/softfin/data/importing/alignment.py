"""How the clocks of command, angle and force lie: what follows what, and by how many milliseconds.

The angle is the yardstick. A command shows in the angle's rate after the drive's dead time; the force shows what the
angle's rate and acceleration did, after the fin has bent and the sensor has filtered.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from softfin.core.quantities import RATE_HZ, TICK_S

COMMAND_LAG_MS = (0.0, 100.0)
"""Plausible from a command to the angle: the way through computer, bus and drive; about 27 ms in the virtual tank,
10 ms in the published fin."""

FORCE_LAG_MS = (0.0, 60.0)
"""Plausible from the angle to the force: 20 ms in the virtual tank, 45 ms in the published fin."""

SEARCHED_TICKS = 20
"""Either way."""

OFFSETS = np.arange(-2 * SEARCHED_TICKS, 4 * SEARCHED_TICKS)
"""Ticks about a step of the command, in which its response is looked for."""

FOLLOWING_TICKS = 15
"""After these, an angle goes the way of its command."""

NEAR_RAD, NEAR_RAD_S = 0.03, 3.0
"""So near its target or its velocity a drive eases off [rad, rad/s]; of the tank's drive, and few others' differ."""

FEWEST_MATCH = 0.5
"""Correlation from which a drive is believed to follow a profile: 0.6 to 0.9 in the tank, 0.35 in the published fin."""

ONSET = 0.25
"""Of the response's peak: where the angle's rate has this much, the drive has begun to obey."""

FEWEST_STEPS = 50
"""Commands from which a lag is told."""

SHORTEST_S = 10
"""Of a recording from which the force's lag and axes are told [s]."""

FEWEST_EXPLAINED = 0.1
"""Share of the force that the angle must explain before a lag is told from it."""


class Motion(NamedTuple):
    """What an angle does, smoothed over 50 ms."""

    angle: Float[np.ndarray, "ticks"]
    velocity: Float[np.ndarray, "ticks"]
    acceleration: Float[np.ndarray, "ticks"]


class Lag(NamedTuple):
    """Of one channel behind another."""

    milliseconds: float
    strength: float
    """Command: correlation with a profile, or the response's peak over the rate's deviation; force: share explained."""


def motion(angle: Float[np.ndarray, "ticks"]) -> Motion:
    """Of an angle at 100 Hz [rad]."""
    smooth = smoothed(angle)
    velocity = np.gradient(smooth, TICK_S)
    return Motion(smooth, velocity, np.gradient(smoothed(velocity), TICK_S))


def smoothed(values: Float[np.ndarray, "ticks"]) -> Float[np.ndarray, "ticks"]:
    """By a Hann window of five samples, which delays nothing."""
    kernel = np.hanning(7)[1:-1] / np.hanning(7).sum()
    return np.convolve(np.pad(values, 2, mode="edge"), kernel, "valid")


def command_lag(
    command: Float[np.ndarray, "ticks"], speed: Float[np.ndarray, "ticks"], angle: Float[np.ndarray, "ticks"]
) -> Lag | None:
    """From a command, its angle [rad] and velocity [rad/s], to the angle; None where too few commands change.

    Commands that step go to a drive that follows a profile, and `_profile_lag` tells when it obeys; where the fin moves
    by no profile, the rise of its response to the steps does. Commands that glide are told by the peak of the response.
    """
    change = np.diff(command, prepend=command[0])
    steps = np.flatnonzero(np.abs(change) > 1e-4)
    steps = steps[(steps >= 2 * SEARCHED_TICKS) & (steps < len(angle) - 4 * SEARCHED_TICKS)]
    if len(steps) < FEWEST_STEPS:
        return None
    if len(steps) > 0.5 * len(command):
        return _gliding_lag(change, steps, angle)
    mirrored = np.corrcoef(command[:-FOLLOWING_TICKS], angle[FOLLOWING_TICKS:])[0, 1] < 0
    lag = _profile_lag(-command if mirrored else command, speed, angle)
    return _stepping_lag(np.sign(change), steps, angle) if lag is None else lag


def _profile_lag(
    command: Float[np.ndarray, "ticks"], speed: Float[np.ndarray, "ticks"], angle: Float[np.ndarray, "ticks"]
) -> Lag | None:
    """At what lag of the command the rate changes towards what it asks for: its speed, until the target is reached."""
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
    best = int(matches.argmax())
    if matches[best] < FEWEST_MATCH or best in (0, len(matches) - 1):
        return None
    return Lag(float((best - SEARCHED_TICKS + _vertex(matches, best)) / RATE_HZ * 1e3), float(matches[best]))


def _stepping_lag(
    side: Float[np.ndarray, "ticks"], steps: Int[np.ndarray, "steps"], angle: Float[np.ndarray, "ticks"]
) -> Lag | None:
    """From the rise of the response: its peak comes while the fin is still on its way."""
    # The median, where every step weighs alike: an encoder that jumps now and then makes no response of its own.
    response = _response(np.median(side[steps][:, None] * motion(angle).velocity[steps[:, None] + OFFSETS], axis=0))
    peak = int(response.argmax())
    below = np.flatnonzero(response[:peak] < ONSET * response[peak])
    if not below.size:
        return None
    low, high = response[below[-1] : below[-1] + 2]
    place = OFFSETS[below[-1]] + (ONSET * response[peak] - low) / (high - low)
    return Lag(float(place / RATE_HZ * 1e3), float(response[peak] / (motion(angle).velocity.std() + 1e-12)))


def _gliding_lag(
    change: Float[np.ndarray, "ticks"], steps: Int[np.ndarray, "steps"], angle: Float[np.ndarray, "ticks"]
) -> Lag | None:
    rate = motion(angle).velocity
    weight = change[steps] - change[steps].mean()
    response = _response(weight @ rate[steps[:, None] + OFFSETS] / np.abs(weight).sum())
    peak = int(response.argmax())
    if peak in (0, len(OFFSETS) - 1):
        return None
    # A difference to the row before is the rate of half a tick ago.
    place = OFFSETS[peak] + _vertex(response, peak) + 0.5
    return Lag(float(place / RATE_HZ * 1e3), float(response[peak] / (rate.std() + 1e-12)))


def _response(after: Float[np.ndarray, "offsets"]) -> Float[np.ndarray, "offsets"]:
    """Off what there was before the steps, and upwards."""
    rise = after - np.median(after[:SEARCHED_TICKS])
    return np.asarray(rise * np.sign(rise[np.abs(rise).argmax()]))


def force_lag(angle: Float[np.ndarray, "ticks"], force: Float[np.ndarray, "ticks 2"]) -> Lag | None:
    """The lag at which a linear model of the angle's motion explains most of the force, whatever its axes and signs.

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
    explained = np.array([_explained(features, inverse, series[k : k + len(features)]) for k in range(2 * ticks + 1)])
    best = int(explained.argmax())
    if best in (0, 2 * ticks) or explained[best] < FEWEST_EXPLAINED:
        return None
    vertex = best + _vertex(explained, best)
    return Lag(float((vertex - ticks) / RATE_HZ * 1e3), float(explained[best]))


def _vertex(values: Float[np.ndarray, "lags"], peak: int) -> float:
    """Of the parabola through a peak and its neighbours, off the peak."""
    left, middle, right = values[peak - 1 : peak + 2]
    bend = left - 2 * middle + right
    return 0.0 if bend == 0 else float((left - right) / 2 / bend)


def _features(moving: Motion) -> Float[np.ndarray, "ticks 10"]:
    """Added mass, drag, thrust and damping, along both axes as the fin turns."""
    angle, velocity, acceleration = moving
    terms = np.stack([acceleration, velocity * np.abs(velocity), velocity**2, velocity, np.ones_like(angle)], axis=1)
    return np.concatenate([terms * np.cos(angle)[:, None], terms * np.sin(angle)[:, None]], axis=1)


def _explained(
    features: Float[np.ndarray, "rows terms"], inverse: Float[np.ndarray, "terms terms"],
    force: Float[np.ndarray, "rows 2"],
) -> float:  # fmt: skip
    centred = force - force.mean(axis=0)
    product = features.T @ centred
    return float((product * (inverse @ product)).sum() / ((centred**2).sum() + 1e-12))
