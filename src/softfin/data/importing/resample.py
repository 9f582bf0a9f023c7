"""Resampling to 100 Hz: readings are interpolated, behind a low-pass where the source is faster; commands are held."""

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import TICK_S

CUTOFF_HZ = 40.0
"""Frequency at which half of the amplitude is left: below the 50 Hz that 100 Hz can show, above all that a fin does."""

KERNEL_S = 0.1
"""Length of the filter [s]: 25 Hz pass and 56 Hz are gone."""

EARLY_S = 1e-6
"""Lateness at which a stamp is still on time [s]: clocks in double precision are no better."""


def interpolated(
    time: Float[np.ndarray, "rows"], values: Float[np.ndarray, "rows"], grid: Float[np.ndarray, "ticks"]
) -> Float[np.ndarray, "ticks"]:
    """Interpolate a reading at other times; `time` rises strictly."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else TICK_S
    if step < 0.67 * TICK_S:
        even = np.linspace(time[0], time[-1], max(2, round((time[-1] - time[0]) / step) + 1))
        values = low_passed(np.interp(even, time, values), step)
        time = even
    return np.asarray(np.interp(grid, time, values))


def low_passed(values: Float[np.ndarray, "rows"], step_s: float) -> Float[np.ndarray, "rows"]:
    """Filter an evenly sampled series by a windowed sinc, which delays nothing; at the ends it sees what there is."""
    half = round(KERNEL_S / 2 / step_s)
    offset = np.arange(-half, half + 1) * step_s
    kernel = np.sinc(2 * CUTOFF_HZ * offset) * np.cos(np.pi * offset / (KERNEL_S + 2 * step_s)) ** 2
    if len(values) < len(kernel):
        return np.full_like(values, values.mean())
    weight = np.convolve(np.ones_like(values), kernel, "same")
    return np.asarray(np.convolve(values, kernel, "same") / weight)


def held(
    time: Float[np.ndarray, "rows"], values: Float[np.ndarray, "rows"], grid: Float[np.ndarray, "ticks"]
) -> Float[np.ndarray, "ticks"]:
    """Take the last value issued by each time; none of `grid` lies before the first."""
    return np.asarray(values[np.searchsorted(time, grid + EARLY_S, side="right") - 1])
