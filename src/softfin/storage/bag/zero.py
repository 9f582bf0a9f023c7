"""Force zero in a bag: a session measures the force at rest and records it as an event, but records
the raw wrench.

This module parses the events and returns the zero at any time, to be subtracted from the readings.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

RestForce = tuple[float, float]
"""Force (x, y) [N]."""

NUMBER = r"(-?\d{1,15}\.\d{4})"
EVENT = re.compile(rf"force at rest: \({NUMBER}, {NUMBER}\) N")


def zero_event(zero: RestForce) -> str:
    """Return the text of the event that records a zero [N]."""
    return f"force at rest: ({zero[0]:.4f}, {zero[1]:.4f}) N"


def parse_zero(text: str) -> RestForce | None:
    """Return the zero [N] that an event records; None for any other event."""
    match = EVENT.fullmatch(text)
    return None if match is None else (float(match[1]), float(match[2]))


def zeros_at(
    zeros: Sequence[tuple[float, RestForce]], time: Float[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows 2"]:
    """Return the zero [N] for each time: the last zero measured by then, or the first zero for
    earlier times.

    `zeros` are sorted by time and on the same clock as `time`; if there are none, the result is 0.
    """
    if not zeros:
        return np.zeros((len(time), 2))
    measured_at, forces = zip(*zeros, strict=True)
    last = np.searchsorted(measured_at, time, side="right") - 1
    return np.array(forces)[np.maximum(last, 0)]
