"""Estimates of a log's time offsets (command to angle, angle to force) and of its force axes.

The angle is the reference clock. A command affects the rate of the angle after the dead time of the
drive. The force follows the rate and acceleration of the angle, delayed by the bending of the fin
and the sensor filter.

To find the force axes, a model fin is fitted to the force under rotations and reversals of the
measured axes. Thrust points along (cos theta, -sin theta) and grows with the square of the rate.
Added mass and drag act along (sin theta, cos theta), against acceleration and rate. No coefficient
may be negative, so a reversed axis fits worse.
"""

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import nnls

from softfin.core.quantities import TICK_S
from softfin.data.importing.importing import FORCE_FRAMES, turned

LogSeries: TypeAlias = Float[np.ndarray, "ticks"]
"""One channel, sampled at 100 Hz."""

ForceSeries: TypeAlias = Complex[np.ndarray, "ticks"]
"""Force along x and y, as real and imaginary parts [N]."""

SEARCHED_TICKS = 20
"""Maximum lag in the search, in either direction [10 ms]."""

FAR_TICKS = 400
"""Maximum lag in the search for a misaligned clock [10 ms]."""

WINDOW_TICKS = 600
"""Length of the windows whose force lags are compared [10 ms]."""

RESPONSE_TICKS = np.arange(-2 * SEARCHED_TICKS, 4 * SEARCHED_TICKS)
"""Ticks around a command step in which the response is searched for."""

MIN_FOLLOWING = 0.5
"""Minimum correlation between the angle and its command at which their lag is considered known;
good logs have at least 0.75."""

MAX_LAG_CHANGE_TICKS = 3
"""Maximum plausible difference between the lags in the first and last third of a log, or between
the lags of the two forces [10 ms]; good logs have 0 or 1."""

FOLLOWING_TICKS = 15
"""Delay after which the angle is compared with its command [10 ms]."""

MIN_ALIGNED_S = 10
"""Shortest recording from which the force lag and the force axes are estimated [s]."""


# The sum of the seven weights is 3, and the first and the last are 0.
HANN_WEIGHTS = np.hanning(7)[1:-1] / 3
"""Weights of `smoothed`."""


def measure_rate(values: LogSeries) -> LogSeries:
    """Return the rate of change per second, smoothed over 50 ms."""
    return np.asarray(np.gradient(smoothed(values), TICK_S))


def smoothed(values: LogSeries) -> LogSeries:
    """Smooth with a five-sample Hann window, which adds no delay."""
    return np.convolve(np.pad(values, 2, mode="edge"), HANN_WEIGHTS, "valid")


def command_lag(command: LogSeries, angle: LogSeries) -> float | None:
    """Estimate the lag from command to angle [ms] as the onset of the median step response.

    The median weights all steps equally, so an occasional encoder jump does not matter. Returns
    None if there are fewer than 50 steps or if the command changes in most rows.
    """
    steps = np.flatnonzero(np.abs(np.diff(command, prepend=command[0])) > 1e-4)
    steps = steps[(steps >= -RESPONSE_TICKS[0]) & (steps < len(angle) - RESPONSE_TICKS[-1])]
    if not 50 <= len(steps) <= 0.5 * len(command):
        return None
    mirrored = np.cov(command[:-FOLLOWING_TICKS], angle[FOLLOWING_TICKS:])[0, 1] < 0
    # Use the direction from the current angle to the new target. The direction of the command step
    # could be wrong, because a slow drive may not have reached the previous target.
    side = np.sign((-command if mirrored else command) - angle)[steps]
    response = np.median(
        side[:, None] * np.gradient(angle)[steps[:, None] + RESPONSE_TICKS], axis=0
    )
    # Onset: the median rate reaches 20% of its peak, interpolated between two ticks.
    onset = 0.2 * response.max()
    below = np.flatnonzero(response[: response.argmax()] < onset)
    if not below.size:
        return None
    low, high = response[below[-1] : below[-1] + 2]
    lag_ticks = RESPONSE_TICKS[below[-1]] + (onset - low) / (high - low)
    # The drive needs 120 ms more for most of a move.
    delay = max(1, round(lag_ticks) + 12)
    following = np.corrcoef(command[:-delay], angle[delay:])[0, 1]
    return float(lag_ticks * TICK_S * 1e3) if abs(following) > MIN_FOLLOWING else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceLag:
    """Lag from angle to force, and the share of the force that a linear model of the motion
    explains."""

    force_lag_ms: float | None = None
    """Best lag within 0.2 s [ms]; None if unknown."""
    force_share: float = 0.0
    """Maximum share of the force variance that the motion explains within 0.2 s."""
    far_lag_ms: float = 0.0
    """Best lag beyond 0.2 s [ms]."""
    far_share: float = 0.0
    """Share of the force variance that the motion explains at `far_lag_ms`."""
    late_force_s: Sequence[float] = ()
    """Starts of the 6 s windows in which the force has a different lag than in most windows [s]."""
    axis_lags_ms: tuple[float, float] | None = None
    """Lags of the forces along x and y, if they differ [ms]."""


def find_force_lag(angle: LogSeries, force: ForceSeries) -> ForceLag:
    """Find the lag at which a linear model of the motion best explains the force, regardless of its
    axes.

    The lag is unknown if it changes, differs between the axes or is at the 0.2 s limit. It is also
    unknown if a lag beyond the limit explains 10% more of the force variance, or if the motion
    explains less than 30%. In the logs of the published networks, it explains at least 45%.
    """
    ticks = min(FAR_TICKS, len(angle) // 4)
    shares = explained_shares(angle, force, ticks)
    is_near = np.abs(np.arange(-ticks, ticks + 1)) <= SEARCHED_TICKS
    far = np.where(is_near, 0, shares)
    near = shares[is_near]
    best = int(near.argmax())
    late = find_late_windows(angle, force)
    of_axes = [
        explained_shares(angle, axis + 0j, SEARCHED_TICKS) for axis in (force.real, force.imag)
    ]
    x, y = [int(own.argmax()) for own in of_axes]
    axis_lags_ms = None
    if abs(x - y) > MAX_LAG_CHANGE_TICKS and min(own.max() for own in of_axes) > 0.5:
        axis_lags_ms = (10.0 * (x - SEARCHED_TICKS), 10.0 * (y - SEARCHED_TICKS))
    lag_ms = None
    is_known = 0 < best < 2 * SEARCHED_TICKS and near[best] >= max(0.3, far.max() - 0.1)
    if is_known and not late and axis_lags_ms is None:
        # Vertex of the parabola through the best lag and its two neighbours.
        left, middle, right = near[best - 1 : best + 2]
        lag_ticks = best - SEARCHED_TICKS + (left - right) / 2 / (left - 2 * middle + right)
        lag_ms = float(lag_ticks * TICK_S * 1e3)
    return ForceLag(
        force_lag_ms=lag_ms,
        force_share=float(near[best]),
        far_lag_ms=(int(far.argmax()) - ticks) * TICK_S * 1e3,
        far_share=float(far.max()),
        late_force_s=late,
        axis_lags_ms=axis_lags_ms,
    )


def explained_shares(angle: LogSeries, force: ForceSeries, ticks: int) -> Float[np.ndarray, "lags"]:
    """Return the share of the force variance that a linear model of the motion explains for each
    lag from -ticks to ticks."""
    heading, rate, acceleration = _motion(angle)
    # Added mass, drag, thrust, damping and a constant, each in both components, which rotate with
    # the fin.
    terms = np.stack([acceleration, rate * np.abs(rate), rate**2, rate, np.ones_like(rate)])
    # The first and last ticks have no partner at the largest lag.
    features = np.concatenate([terms * heading.real, terms * heading.imag])[:, ticks:-ticks]
    features -= features.mean(axis=1, keepdims=True)
    features /= features.std(axis=1, keepdims=True) + 1e-12
    # If B is an orthonormal basis of the space of the features, they explain the share |B f|^2 /
    # |f|^2 of a force f. This needs one product per lag instead of one fit.
    _, sizes, basis = np.linalg.svd(features, full_matrices=False)
    ones = np.ones(len(rate) - 2 * ticks)
    explained = np.zeros(2 * ticks + 1)
    total = np.full(2 * ticks + 1, 1e-12)
    for axis in filter(np.any, (force.real, force.imag)):
        smooth = smoothed(axis - axis.mean())
        for vector in basis[sizes > 1e-5 * sizes[0]]:
            explained += np.correlate(smooth, vector, "valid") ** 2
        total += np.correlate(smooth**2, ones, "valid")
        total -= np.correlate(smooth, ones, "valid") ** 2 / len(ones)
    return np.asarray(explained / total)


def find_late_windows(angle: LogSeries, force: ForceSeries) -> list[float]:
    """Return the starts [s] of the windows of `WINDOW_TICKS` in which the force has a different lag
    than in most windows.

    In such a window, its best lag explains nearly as much of the variance as in most windows, and
    at least 12% more than any lag within 40 ms of the usual lag; in good logs, it explains up to
    10% more. If the lag drifts, the windows of the last third are returned.
    """
    starts = np.arange(0, len(angle) - WINDOW_TICKS + 1, WINDOW_TICKS // 2)
    windows = [slice(start, start + WINDOW_TICKS) for start in starts]
    shares = np.stack([explained_shares(angle[rows], force[rows], 60) for rows in windows])
    lags = shares.argmax(axis=1)
    usual = int(np.median(lags))
    at_usual = shares[:, max(usual - 4, 0) : usual + 5].max(axis=1)
    own = shares.max(axis=1)
    is_late = (own > at_usual + 0.12) & (own > 0.8 * np.median(own))
    third = len(lags) // 3
    if third >= 2:
        change = np.median(lags[-third:]) - np.median(lags[:third])
        is_late[-third:] |= abs(change) >= MAX_LAG_CHANGE_TICKS and np.median(own) > 0.5
    late: list[float] = (starts[is_late] * TICK_S).tolist()
    return late


@dataclasses.dataclass(frozen=True, kw_only=True)
class Orientation:
    """Correlations between the force in different axes and the best fit of a model fin."""

    frames: dict[str, float] | None = None
    """Correlation in each of `FORCE_FRAMES`; None if unknown."""
    turn_deg: int = 0
    """Counterclockwise rotation of the recorded force for the best fit [degrees], in steps of 5
    from -45 to 45."""
    frame: str = "x,y"
    """Frame with the best fit after this rotation."""
    correlation: float = 0.0
    """Correlation after this rotation and in this frame."""
    shaft_correlation: float = 0.0
    """Maximum correlation if the sensor turns with the shaft."""
    is_shaft_reversed: bool = False
    """Whether the sensor then seems to turn in the opposite direction, because the angle has the
    wrong sign."""


def find_orientation(angle: LogSeries, force: ForceSeries) -> Orientation:
    """Search all frames and rotations for the axes in which a model fin fits the force best."""
    fits = {}
    on_shaft = {-1: 0.0, 1: 0.0}
    for degrees in range(-45, 46, 5):
        turned_force = force * np.exp(1j * np.radians(degrees))
        fits[degrees] = frame_correlations(angle, turned_force)
        if degrees % 15 == 0:
            # At a positive angle, the shaft is turned clockwise.
            for sign, largest in on_shaft.items():
                on_mount = turned_force * np.exp(sign * 1j * angle)
                correlations = frame_correlations(angle, on_mount).values()
                on_shaft[sign] = max(largest, *correlations)
    turn_deg = max(fits, key=lambda degrees: max(fits[degrees].values()))
    best = fits[turn_deg]
    frame = max(best, key=best.__getitem__)
    return Orientation(
        frames=fits[0],
        turn_deg=turn_deg,
        frame=frame,
        correlation=best[frame],
        shaft_correlation=max(on_shaft.values()),
        is_shaft_reversed=on_shaft[1] > on_shaft[-1],
    )


def frame_correlations(angle: LogSeries, force: ForceSeries) -> dict[str, float]:
    """Return the correlation between the force in each of `FORCE_FRAMES` and the best fit of a
    model fin."""
    heading, rate, acceleration = _motion(angle)
    speed = np.abs(rate)
    # Drag, added mass, quadratic thrust and linear thrust.
    terms = np.stack([-1j * rate * speed, -1j * acceleration, rate**2, speed]) * heading
    terms -= terms.mean(axis=1, keepdims=True)
    model = np.concatenate([terms.real, terms.imag], axis=1).T
    model /= np.linalg.norm(model, axis=0) + 1e-12
    smooth = np.stack([smoothed(force.real), smoothed(force.imag)])
    smooth -= smooth.mean(axis=1, keepdims=True)
    smooth /= np.linalg.norm(smooth) + 1e-12
    # QR reduces the fit from two equations per tick to four equations in total.
    basis, model = np.linalg.qr(model)
    correlations = {}
    for frame in FORCE_FRAMES:
        projected = basis.T @ np.concatenate(turned(smooth[0], smooth[1], frame))
        # Non-negative least squares: a reversed axis would need a negative coefficient.
        coefficients, _ = nnls(model, projected)
        correlations[frame] = float(np.linalg.norm(model @ coefficients))
    return correlations


def _motion(angle: LogSeries) -> tuple[ForceSeries, LogSeries, LogSeries]:
    """Return the direction of thrust as a complex number, and the rate [rad/s] and acceleration
    [rad/s^2] of the fin."""
    rate = measure_rate(angle)
    return np.exp(-1j * smoothed(angle)), rate, measure_rate(rate)
