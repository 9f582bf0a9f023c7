"""Scale of a drawing: the part of the tank that is seen, and how long a newton is drawn."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.evaluation.view.footage import Footage

LONGEST, MEAN_LONGEST = 0.65, 0.4
"""Length of the arrows of the greatest force, and of the greatest reference or mean force, over that of the fin; the
second would be too short to see beside the peaks of a stroke."""

TRAIL_TICKS = (5, 10, 15, 20, 25)
"""How long ago the faint shapes behind the fin were [10 ms]."""

Range = tuple[float, float]
Vectors = Float[np.ndarray, "_ 2"]
NONE = np.zeros((1, 2))


class Scale(NamedTuple):
    """Scale of one footage, the same for all its frames."""

    length_m: float
    """Length of the fin [m]."""
    metres_per_newton: float
    """Scale of the force's arrow."""
    key_n: float
    """A round force for the key [N]."""
    metres_per_mean_newton: float
    """Scale of the reference and the mean force."""
    mean_key_n: float
    """A round force for their key [N]."""
    x: Range
    """Seen part of the tank [m]."""
    y: Range
    """Seen part of the tank [m]."""
    force: Range
    """Axis of the force traces [N]."""
    angle: Range
    """Axis of the angle's trace [rad]."""
    stream_m_s: float
    """The fastest stream [m/s]."""


class Greatest(NamedTuple):
    """Sizes of the greatest vectors in a footage."""

    force_n: float
    """Greatest force [N]."""
    mean_n: float
    """Greatest reference or mean force [N]."""
    stream_m_s: float
    """Fastest stream [m/s]."""

    @classmethod
    def of(cls, footage: Footage) -> "Greatest":
        """Return the sizes in a footage; 0 where it has none."""
        asked = NONE if footage.reference is None else footage.reference
        stream = NONE if footage.stream is None else footage.stream
        vectors = (footage.reading.force, np.concatenate([footage.average, asked]), stream)
        return cls(*(float(np.linalg.norm(each, axis=1).max()) for each in vectors))

    def including(self, footage: Footage) -> "Greatest":
        """Grow in round numbers to what a footage needs, so that a growing drawing seldom changes its scale."""
        pairs = zip(Greatest.of(footage), self, strict=True)
        return Greatest(*(had if value <= had else round_up(value) for value, had in pairs))

    def scale(self, length_m: float, angle: Range) -> Scale:
        """Return a scale for a fin of this length, wherever it turns, with the angle's axis over its limits [rad]."""
        corners = np.array([[-length_m, -length_m], [LONGEST * length_m, length_m]])
        return _fit(length_m, self, corners, (-self.force_n, self.force_n), angle)


def scale_of(footage: Footage) -> Scale:
    """Return the scale by which fin and arrows stay in the picture at every tick."""
    force = np.asarray(footage.reading.force, float)
    asked = np.zeros((0, 2)) if footage.reference is None else np.unique(footage.reference, axis=0)
    shown, greatest = np.concatenate([force, asked]), Greatest.of(footage)
    # Half a newton at least, so that the noise of a fin at rest is not blown up.
    force_n = max(float(np.linalg.norm(shown, axis=1).max()), 0.5)
    mean_n = force_n if footage.reference is None else max(greatest.mean_n, 0.25)
    angles = np.concatenate([footage.reading.angle, footage.command.angle])
    return _fit(
        footage.length_m, Greatest(force_n, mean_n, greatest.stream_m_s), footage.shape.reshape(-1, 2),
        (min(float(shown.min()), 0.0), max(float(shown.max()), 0.0)), (float(angles.min()), float(angles.max())),
        force, np.concatenate([footage.average, asked]),
    )  # fmt: skip


def _fit(
    length_m: float, greatest: Greatest, points: Vectors, force: Range, angle: Range,
    forces: Vectors = NONE, means: Vectors = NONE,
) -> Scale:  # fmt: skip
    per_newton = LONGEST * length_m / greatest.force_n
    per_mean_newton = max(MEAN_LONGEST * length_m / greatest.mean_n, per_newton)
    seen = np.concatenate([points, forces * per_newton, means * per_mean_newton, NONE])
    margin = 0.12 * length_m
    (left, bottom), (right, top) = (seen.min(axis=0) - margin).tolist(), (seen.max(axis=0) + margin).tolist()
    return Scale(
        length_m=length_m,
        metres_per_newton=per_newton,
        key_n=_round_down(greatest.force_n / 2),
        metres_per_mean_newton=per_mean_newton,
        mean_key_n=_round_down(greatest.mean_n / 2),
        x=(left, right),
        y=(bottom, top),
        force=_padded(*force),
        angle=_padded(*angle),
        stream_m_s=greatest.stream_m_s,
    )


def round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, 20 .."""
    lower = _round_down(value)
    return lower if lower >= value else _round_down(2.5 * lower)


def _padded(low: float, high: float) -> Range:
    pad = 0.06 * max(high - low, 1e-3)
    return low - pad, high + pad


def _round_down(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)
