"""From any clock to 100 Hz: readings by interpolation, behind a low-pass where the source is faster; commands held."""

import numpy as np
from jaxtyping import Float, Int

from softfin.core.quantities import TICK_S

CUTOFF_HZ = 40.0
"""Half of the amplitude is left at this: below the 50 Hz that 100 Hz can show, above all that a fin does."""

KERNEL_S = 0.1
"""Length of the filter [s]: 25 Hz pass and 56 Hz are gone."""

EARLY_S = 1e-6
"""A stamp that is this little late is on time: clocks in double precision are no better."""


def interpolated(
    time: Float[np.ndarray, "rows"], values: Float[np.ndarray, "rows"], grid: Float[np.ndarray, "ticks"]
) -> Float[np.ndarray, "ticks"]:
    """A reading at other times; `time` rises strictly."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else TICK_S
    if step < 0.67 * TICK_S:
        even = np.linspace(time[0], time[-1], max(2, round((time[-1] - time[0]) / step) + 1))
        values = low_passed(np.interp(even, time, values), step)
        time = even
    return np.asarray(np.interp(grid, time, values))


def low_passed(values: Float[np.ndarray, "rows"], step_s: float) -> Float[np.ndarray, "rows"]:
    """Of an evenly sampled series: a windowed sinc, which delays nothing; at the ends it sees what there is."""
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
    """The last value that was issued by each time; none of `grid` lies before the first."""
    return np.asarray(values[last_before(time, grid)])


def last_before(time: Float[np.ndarray, "rows"], grid: Float[np.ndarray, "ticks"]) -> Int[np.ndarray, "ticks"]:
    """The row that holds at each time."""
    return np.asarray(np.searchsorted(time, grid + EARLY_S, side="right")) - 1
