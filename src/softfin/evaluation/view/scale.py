"""Where things go in a drawing: the part of the tank that is seen, and how long a newton is drawn."""

from typing import NamedTuple

import numpy as np

from softfin.evaluation.view.footage import Footage

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
    length = fin_length(footage)
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


def fin_length(footage: Footage) -> float:
    """Along the fin, from the shaft to the tip [m]."""
    return float(np.linalg.norm(np.diff(footage.shape[0], axis=0), axis=1).sum())


class Room(NamedTuple):
    """What has to find room in a drawing of a footage that is still growing, in round numbers."""

    force_n: float
    """The greatest force."""
    mean_n: float
    """The greatest reference or mean force."""
    stream_m_s: float

    def scale(self, length_m: float, angle: tuple[float, float]) -> Scale:
        """A scale for a fin of this length, wherever it turns, with the angle's axis over its limits [rad]."""
        per_newton = LONGEST * length_m / self.force_n
        margin = 0.12 * length_m
        return Scale(
            length_m=length_m,
            metres_per_newton=per_newton,
            key_n=_round_down(self.force_n / 2),
            metres_per_mean_newton=max(MEAN_LONGEST * length_m / self.mean_n, per_newton),
            mean_key_n=_round_down(self.mean_n / 2),
            x=(-length_m - margin, LONGEST * length_m + margin),
            y=(-length_m - margin, length_m + margin),
            force=_padded(-self.force_n, self.force_n),
            angle=_padded(*angle),
            stream_m_s=self.stream_m_s,
        )


def room_for(footage: Footage, before: Room) -> Room:
    """For a footage, and no less than before, so that a drawing of a growing one seldom changes its scale."""
    asked = np.zeros((1, 2)) if footage.reference is None else footage.reference
    stream = np.zeros((1, 2)) if footage.stream is None else footage.stream
    seen = (footage.reading.force, np.concatenate([footage.average, asked]), stream)
    greatest = (float(np.linalg.norm(vectors, axis=1).max()) for vectors in seen)
    return Room(*(had if value <= had else round_up(value) for value, had in zip(greatest, before, strict=True)))


def round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20 .."""
    lower = _round_down(value)
    return lower if lower >= value else _round_down(2.5 * lower)


def _padded(low: float, high: float) -> tuple[float, float]:
    pad = 0.06 * max(high - low, 1e-3)
    return low - pad, high + pad


def _round_down(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)
