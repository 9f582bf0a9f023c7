"""Axes of force sensors: the rotation from how a sensor is mounted to softfin's axes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from softfin.rig.machine import Wrench


def rotation(frame: str) -> Float[np.ndarray, "3 3"]:
    """Rotation from the sensor's axes into softfin's; `frame` is +x and +y in the sensor's own axes, as ``y,-x``.

    It is a rotation whatever the frame: where x and y are mirrored, as in ``y,x``, the sensor looks the other way, so
    its z is reversed.
    """
    rows = np.zeros((2, 3))
    for row, axis in zip(rows, frame.split(","), strict=True):
        row["xy".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return np.vstack([rows, np.cross(*rows)])


def rotated(wrench: Sequence[float] | Float[np.ndarray, " 6"], turn: Float[np.ndarray, "3 3"]) -> Wrench:
    """Force and torque after a rotation."""
    fx, fy, fz, tx, ty, tz = (np.reshape(wrench, (2, 3)) @ turn.T).ravel().tolist()
    return fx, fy, fz, tx, ty, tz
