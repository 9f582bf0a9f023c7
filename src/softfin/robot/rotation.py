"""Rotations as unit quaternions (w, x, y, z) from body axes to world axes; NumPy on the robot, JAX
in programs."""

from typing import Any

import numpy as np
from jaxtyping import Float

from softfin.core.operations import Array, select_operations
from softfin.core.quantities import AnyArray

Vector = Float[AnyArray, "3"]
Quaternion = Float[AnyArray, "4"]
SixVector = Float[AnyArray, "6"]
"""A twist or a wrench: three numbers of translation, three of rotation."""

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""Body axes along world axes."""


def _namespace(*arrays: Array) -> Any:
    return select_operations(*arrays).xp


def six(first: Array, second: Array) -> SixVector:
    """Return two vectors ``(3,)`` as one of six numbers."""
    joined: SixVector = _namespace(first, second).concatenate([first, second])
    return joined


def cross(a: Array, b: Array) -> Array:
    """Return the vector product of two vectors ``(3,)``; much faster than NumPy's own for such
    short vectors."""
    xp = _namespace(a, b)
    a0, a1, a2 = a
    b0, b1, b2 = b
    return xp.asarray([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def matrix(quaternion: Array) -> Array:
    """Return the rotation matrix ``(3, 3)`` from body axes to world axes."""
    xp = _namespace(quaternion)
    w, x, y, z = quaternion
    return xp.asarray(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def multiply(a: Array, b: Array) -> Array:
    """Return the rotation by `b` first, then by `a`."""
    xp = _namespace(a, b)
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return xp.asarray(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def inverse_rotation(quaternion: Array) -> Array:
    """Return the opposite rotation."""
    return quaternion * _namespace(quaternion).asarray([1.0, -1.0, -1.0, -1.0])


def normalized(quaternion: Array) -> Array:
    """Return the quaternion normalised to length 1."""
    return quaternion / (quaternion @ quaternion) ** 0.5


def from_vector(vector: Array) -> Array:
    """Return the rotation about a vector by an angle equal to its length [rad]."""
    xp = _namespace(vector)
    # sinc has a derivative at 0, where a quotient has none.
    half = xp.sqrt(vector @ vector + 1e-30) / 2
    return xp.concatenate([xp.cos(half)[None], vector * (xp.sin(half) / (2 * half))])


def to_vector(quaternion: Array) -> Array:
    """Return the vector of a rotation: its axis times its angle, 0 .. pi [rad]."""
    xp = _namespace(quaternion)
    quaternion = xp.where(quaternion[0] < 0, -quaternion, quaternion)
    sine = xp.sqrt(quaternion[1:] @ quaternion[1:] + 1e-30)
    return quaternion[1:] * (2 * xp.arctan2(sine, quaternion[0]) / sine)


def from_euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the rotation by yaw about z, pitch about the new y, roll about the new x [rad] (REP
    103)."""
    x, y, z = map(from_vector, np.diag([roll, pitch, yaw]))
    return np.asarray(multiply(z, multiply(y, x)))
