"""Frequency response of a controlled force: gain and phase of the mean force over one window, while
the reference turns about a force or pulses along it.

At the rate f of the reference, both signals are fitted by least squares:

    z(t) = m + A exp(2 pi i f t) + B exp(-2 pi i f t),  z = x + i y [N] if the reference turns
                                                        z = force along the centre [N] if it pulses

The response is A of the mean force divided by A of the tracked reference. The mean over a window
that ends at t has a response of its own, W(f) = mean of exp(-2 pi i f k dt) over the ticks k of the
window, which is 0 at multiples of 1 / window. A force that equals its reference has the response W.
"""

import cmath
import math
from typing import TypedDict

import numpy as np
from jaxtyping import Complex, Float

from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.core.window import moving_average

MIN_WINDOW_GAIN = 0.02
"""Gain of the window below which the response of the force is not computed."""

ForceSeries = Float[np.ndarray, "ticks 2"]


class ResponseRow(TypedDict):
    """Response at one rate; phases are in (-180, 180], negative if the force lags."""

    rate_hz: float
    gain: float
    """Gain of the mean force over one window."""
    phase_deg: float
    window_gain: float
    """Gain of the averaging alone."""
    window_phase_deg: float
    force_gain: float | None
    """`gain` divided by `window_gain`; None if the window averages this rate out."""
    force_phase_deg: float | None
    counter_gain: float
    """Gain of the part that turns the other way; for a pulse, the same as `gain`."""
    remainder_n: float
    """RMS of the mean force that does not have this rate [N]."""


def window_response(rate_hz: float, window: int) -> complex:
    """Return the response of the mean over a window that ends at the current tick."""
    return complex(np.exp(-2j * np.pi * rate_hz * np.arange(window) / RATE_HZ).mean())


def response(
    force: ForceSeries,
    reference: ForceSeries,
    rate_hz: float,
    window: int,
    settle_s: float | int,
    direction: complex | None = None,
) -> ResponseRow:
    """Return the response of a force to a reference at one rate.

    Windows that end in the first `settle_s` seconds are left out. `direction` is x + i y of a unit
    vector along which the reference pulses; None if it turns.
    """
    first = max(round(settle_s * RATE_HZ), window - 1)
    mean = moving_average(force, window)[first - (window - 1) :]
    signals = [series @ np.array([1, 1j]) for series in (mean, reference[first:])]
    if direction is not None:
        signals = [(signal * direction.conjugate()).real + 0j for signal in signals]
    time_s = np.arange(first, len(reference)) * TICK_S
    (forward, backward, remainder_n), (asked, _, _) = (
        _fit(signal, time_s, rate_hz) for signal in signals
    )
    gain = forward / asked
    own = window_response(rate_hz, window)
    has_force = abs(own) >= MIN_WINDOW_GAIN
    return {
        "rate_hz": rate_hz,
        "gain": abs(gain),
        "phase_deg": _degrees(gain),
        "window_gain": abs(own),
        "window_phase_deg": _degrees(own),
        "force_gain": abs(gain / own) if has_force else None,
        "force_phase_deg": _degrees(gain / own) if has_force else None,
        "counter_gain": abs(backward / asked),
        "remainder_n": remainder_n,
    }


def _degrees(number: complex) -> float:
    return math.degrees(cmath.phase(number))


def _fit(
    signal: Complex[np.ndarray, "ticks"], time_s: Float[np.ndarray, "ticks"], rate_hz: float
) -> tuple[complex, complex, float]:
    """Fit a signal; return A, B and the RMS of the remainder."""
    turn = np.exp(2j * np.pi * rate_hz * time_s)
    basis = np.stack([np.ones_like(turn), turn, turn.conj()], axis=1)
    fitted = np.linalg.lstsq(basis, signal)[0]
    remainder_n = float(np.sqrt((abs(signal - basis @ fitted) ** 2).mean()))
    return complex(fitted[1]), complex(fitted[2]), remainder_n
