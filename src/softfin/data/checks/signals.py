"""Statistics of channels: invalid samples, frozen, clipped and filtered values, drift and
scales."""

import numpy as np
from jaxtyping import Bool

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.data.checks.alignment import MIN_ALIGNED_S, ForceSeries, LogSeries, measure_rate

SINGLE_SAMPLE = np.array([0, 0, 0, 0, -0.5, 1, -0.5, 0, 0, 0, 0])
"""Second differences around a single invalid sample, divided by the second difference at the
sample."""


def true_runs(flags: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    """Return (first row, one past the last row) of each run of True."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def usual_range(values: LogSeries) -> float:
    """Return the range of 98% of the samples."""
    return float(np.ptp(np.percentile(values, [1, 99])))


def without_spikes(values: LogSeries) -> LogSeries:
    """Replace outliers of one or two samples with the median of five samples.

    A spike deviates from this median by more than 1.2 times half the range of 98% of the samples;
    jumps in the logs of the published networks reach 0.8 times. The second difference must also
    have a robust z-score above 8, so that noise is not treated as spikes.

    Five or more smaller deviations of single samples are also spikes if the neighbouring samples
    are smooth. Logs of the published networks have up to three such deviations.
    """
    if len(values) < MIN_ALIGNED_S * RATE_HZ:
        return values
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5)
    middle = np.median(windows, axis=1)
    deviation = np.abs(values - middle)
    bend = np.pad(np.diff(values, 2), 1)
    size = np.abs(bend)
    # At rest, most second differences are exactly 0, so only the other ones set the scale. The
    # standard deviation of normal noise is 1.4826 times the median of absolute values.
    scale = 1.4826 * float(np.median(size[size > 0])) if bend.any() else 0.0
    half_range = max(0.5 * usual_range(values), 1e-9)
    is_spike = (deviation > 1.2 * half_range) & (size > 8.0 * scale)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(bend, 5, mode="edge"), 11)
    misfit = np.abs(around - bend[:, None] * SINGLE_SAMPLE).max(axis=1)
    is_single = (misfit < 0.3 * size) & (deviation > max(0.06 * half_range, 2 * scale))
    if is_single.sum() >= 5:
        is_spike |= is_single
    return np.where(is_spike, middle, values)


def frozen_runs(values: LogSeries) -> list[tuple[int, int]]:
    """Return the runs of a second and more in which a channel keeps its value but for one count,
    the smallest usual step, in either direction."""
    if len(values) < RATE_HZ:
        return []
    steps = np.abs(np.diff(values))
    count = float(np.percentile(steps[steps > 0], 1)) if steps.any() else 0.0
    # One count of a coarse channel is not small.
    tolerance = min(2.001 * count, 0.04 * usual_range(values))
    windows = np.lib.stride_tricks.sliding_window_view(values, RATE_HZ)
    is_frozen = np.ptp(windows, axis=1) <= tolerance
    # A row is frozen if any window that contains it is.
    return true_runs(np.convolve(is_frozen, np.ones(RATE_HZ)) > 0.5)


def clipped_rows(values: LogSeries, moving: Bool[np.ndarray, "ticks"]) -> list[tuple[int, int]]:
    """Return the runs of samples at the upper end of the range if the sensor saturates there.

    Most of the highest samples of a clipped signal are within 1% of its range, even if it was
    filtered later. Good logs have at most twice as many samples in this 1% as in the next 4%.
    """
    below = (values.max() - values) / max(usual_range(values), 1e-9)
    at_end = moving & (below < 0.01)
    num_close = (moving & (below < 0.05)).sum() - at_end.sum()
    return true_runs(at_end) if at_end.sum() >= max(10, 3 * num_close) else []


def roughness(force: ForceSeries) -> float:
    """Return the size of the third differences of the force, relative to its first differences."""
    first = np.diff(force)
    return float(np.std(np.diff(first, 2)) / (np.std(first) + 1e-12))


def repeated_share(values: LogSeries | ForceSeries, moving: Bool[np.ndarray, "ticks"]) -> float:
    """Return the share of the rows with a moving fin that repeat the value of the previous row."""
    repeats = np.diff(values)[moving[1:]] == 0
    return float(repeats.sum() / max(len(repeats), 1))


def drift(force: LogSeries) -> float:
    """Return the change of a force over the log: ten times the slope of the medians of ten equal
    parts."""
    medians = [float(np.median(part)) for part in np.array_split(force, 10)]
    return 10 * float(np.polyfit(range(10), medians, 1)[0])


def velocity_ratio(angle: LogSeries, velocity: LogSeries) -> tuple[float, float]:
    """Return the correlation between the changes of the angle and of the integrated velocity over
    half a second, and their ratio; both are 0 if either is constant."""
    ticks = RATE_HZ // 2
    if len(angle) <= ticks:
        return 0.0, 0.0
    change = angle[ticks:] - angle[:-ticks]
    expected = np.convolve(velocity[1:], np.full(ticks, TICK_S), "valid")
    if change.std() < 0.02 or velocity.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(change, expected)[0, 1])
    # Slope of a least-squares line: r std(y) / std(x).
    return correlation, correlation * float(expected.std() / change.std())


def speed_ratio(command: LogSeries, velocity: LogSeries, angle: LogSeries) -> float | None:
    """Return the median ratio of the speed to the commanded velocity while the fin moves steadily
    and is more than 0.1 rad from its target; None for less than half a second of such motion."""
    rate = measure_rate(angle)
    speed = np.abs(rate)
    # Steady: the speed would take more than 0.1 s to change by itself.
    is_steady = (np.abs(command - angle) > 0.1) & (0.1 * np.abs(measure_rate(rate)) < speed)
    is_steady &= velocity > 0
    if is_steady.sum() < RATE_HZ // 2:
        return None
    return float(np.median(speed[is_steady] / velocity[is_steady]))


def fin_length(angle: LogSeries, force: ForceSeries) -> float:
    """Estimate the length of a fin in water [m]: the force is about density * length^4 * rate^2.
    For fins of 0.1 to 0.5 m in the virtual tank, the error is within 20%."""
    motion = 1000.0 * (measure_rate(angle) ** 2).mean()
    return float(1.15 * (force.std() / max(motion, 1e-9)) ** 0.25)
