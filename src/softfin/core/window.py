"""The evaluation window: controllers are rewarded and evaluated based on the mean force over 200
samples (paper, Sec. IV-B).

    mean = sum(f) / 200        error = mean - reference

This module computes all such means, their errors and their confidence intervals. Functions of
forces accept NumPy and JAX arrays.
"""

import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import AnyArray

PAPER_WINDOW = PAPER_CLOCK.window_ticks
"""Number of samples in the window of the paper's clock."""

CONFIDENCE = 0.95

FEWEST = 3
"""Minimum number of samples for an interval of the mean; with two samples, the interval is 12.7
times as wide as their difference."""


def window_mean(forces: Float[AnyArray, "n 2"], count: Int[AnyArray, ""]) -> Any:
    """Return the mean force over the last `count` of `n` samples [N]; ``count >= 1``."""
    # A mask instead of a slice because `count` may be traced.
    xp: Any = forces.__array_namespace__()
    counts = xp.arange(len(forces)) >= len(forces) - count
    return xp.where(counts[:, None], forces, 0).sum(axis=0) / count


def sobolev(
    forces: Float[AnyArray, "n 2"], count: Int[AnyArray, ""], form: Literal["sum", "mean"] = "mean"
) -> Any:
    """Return the Sobolev term over the last `count` of `n` samples (paper Sec. III-C2) [N]: the
    change between consecutive forces.

    The form `sum` from the paper, sqrt(sum_i |F_{i+1} - F_i|^2), grows with the square root of the
    window length; the form `mean` from the published code is the root mean square.
    """
    xp: Any = forces.__array_namespace__()
    counts = xp.arange(len(forces) - 1) >= len(forces) - count
    square = xp.where(counts[:, None], xp.diff(forces, axis=0) ** 2, 0).sum(axis=0)
    if form == "mean":
        square = square / xp.maximum(count - 1, 1)
    # The square root, but with slope 0 at 0: a fin at rest produces no force, and the derivative of
    # the square root is infinite there. The inner `where` keeps the infinity out of the gradient.
    moves = square > 0
    return xp.where(moves, xp.sqrt(xp.where(moves, square, 1)), 0)


def moving_average(
    series: Float[AnyArray, "*batch ticks channels"], window: int = PAPER_WINDOW
) -> Any:
    """Return the mean over each complete window, ``(*batch, windows, channels)``; the first covers
    the first `window` samples."""
    xp: Any = series.__array_namespace__()
    # In float64 if available, because the difference between two long cumulative sums loses digits
    # in float32.
    total = xp.cumsum(series, axis=-2, dtype=np.float64 if xp is np else series.dtype)
    # sum over window i = total[i + window] - total[i]
    total = xp.concatenate([xp.zeros_like(total[..., :1, :]), total], axis=-2)
    return (total[..., window:, :] - total[..., :-window, :]) / window


def moving_error(
    series: Float[AnyArray, "*batch ticks channels"],
    reference: AnyArray,
    window: int = PAPER_WINDOW,
) -> Any:
    """Return the mean of |moving average - reference| over all complete windows; `reference` is
    broadcast against the windows."""
    return abs(moving_average(series, window) - reference).mean(axis=-2)


def window_means(
    series: Float[np.ndarray, "*batch ticks channels"],
) -> Float[np.ndarray, "*batch windows channels"]:
    """Return the means over adjacent, non-overlapping windows; an incomplete window at the end is
    dropped."""
    *batch, ticks, channels = series.shape
    count = ticks // PAPER_WINDOW
    windows = series[..., : count * PAPER_WINDOW, :].astype(np.float64)
    return np.asarray(windows.reshape(*batch, count, PAPER_WINDOW, channels).mean(axis=-2))


def interval(
    values: Float[np.ndarray, "samples"], confidence: float = CONFIDENCE
) -> list[float] | None:
    """Return the interval [low, high] of the mean of independent samples, by Student's t.

    Returns None for fewer than `FEWEST` samples, or if all samples are equal and therefore not
    independent.
    """
    n = len(values)
    if n < FEWEST or np.ptp(values) == 0:
        return None
    # mean +- t * s / sqrt(n), with n - 1 degrees of freedom
    quantile = stdtrit(n - 1, (1 + confidence) / 2)
    half = float(quantile * np.std(values, ddof=1) / math.sqrt(n))
    mean = float(np.mean(values))
    return [mean - half, mean + half]
