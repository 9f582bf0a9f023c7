"""Where things go in a drawing: the part of the tank that is seen, and how long a newton is drawn."""

from typing import NamedTuple

import numpy as np

from softfin.viewing.footage import Footage

LONGEST = 0.65
"""Length of the arrow of the greatest force, over that of the fin."""

MEAN_LONGEST = 0.4
"""The same of the greatest reference or mean force, which would be too short to see beside the peaks of a stroke."""

TRAIL_TICKS = (5, 10, 15, 20, 25)
"""How long ago the faint shapes behind the fin were [10 ms]."""


class Scale(NamedTuple):
    """Of one footage, the same for all its frames."""

    length_m: float
    """Of the fin."""
    metres_per_newton: float
    key_n: float
    """A round force for the key."""
    metres_per_mean_newton: float
    """Of the reference and the mean force."""
    mean_key_n: float
    """A round force for their key."""
    x: tuple[float, float]
    """Seen part of the tank [m]."""
    y: tuple[float, float]
    force: tuple[float, float]
    """Axis of the force traces [N]."""
    angle: tuple[float, float]
    """Axis of the angle's trace [rad]."""
    stream_m_s: float
    """The fastest stream."""


def scale_of(footage: Footage) -> Scale:
    """So that fin and arrow stay in the picture at every tick."""
    length = float(np.linalg.norm(np.diff(footage.shape[0], axis=0), axis=1).sum())
    force = np.asarray(footage.reading.force, float)
    asked = np.zeros((0, 2)) if footage.reference is None else np.unique(footage.reference, axis=0)
    means = np.concatenate([footage.average, asked])
    shown = np.concatenate([force, asked])
    # Half a newton at least, so that the noise of a fin at rest is not blown up.
    greatest = max(float(np.linalg.norm(shown, axis=1).max()), 0.5)
    metres_per_newton = LONGEST * length / greatest
    metres_per_mean, greatest_mean = metres_per_newton, greatest
    if footage.reference is not None:
        greatest_mean = max(float(np.linalg.norm(means, axis=1).max()), 0.25)
        metres_per_mean = max(MEAN_LONGEST * length / greatest_mean, metres_per_newton)
    arrows = [force * metres_per_newton, means * metres_per_mean]
    seen = np.concatenate([footage.shape.reshape(-1, 2), *arrows, np.zeros((1, 2))])
    margin = 0.12 * length
    low, high = seen.min(axis=0) - margin, seen.max(axis=0) + margin
    angles = np.concatenate([footage.reading.angle, footage.command.angle])
    return Scale(
        length_m=length,
        metres_per_newton=metres_per_newton,
        key_n=_round_down(greatest / 2),
        metres_per_mean_newton=metres_per_mean,
        mean_key_n=_round_down(greatest_mean / 2),
        x=(float(low[0]), float(high[0])),
        y=(float(low[1]), float(high[1])),
        force=_padded(min(float(shown.min()), 0.0), max(float(shown.max()), 0.0)),
        angle=_padded(float(angles.min()), float(angles.max())),
        stream_m_s=0.0 if footage.stream is None else float(np.linalg.norm(footage.stream, axis=1).max()),
    )


def _padded(low: float, high: float) -> tuple[float, float]:
    pad = 0.06 * max(high - low, 1e-3)
    return low - pad, high + pad


def _round_down(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)
