"""Rotations as unit quaternions (w, x, y, z) from body to world axes, with NumPy on the robot and
JAX in simulations."""

from typing import Any

import numpy as np
from jaxtyping import Float

from softfin.core.operations import Array, select_operations
from softfin.core.quantities import AnyArray

Vector = Float[AnyArray, "3"]
Quaternion = Float[AnyArray, "4"]
SixVector = Float[AnyArray, "6"]
"""Twist or wrench: three components for translation, then three for rotation."""

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""Rotation with body axes parallel to world axes."""


def _namespace(*arrays: Array) -> Any:
    return select_operations(*arrays).xp


def six(first: Array, second: Array) -> SixVector:
    """Concatenate two vectors ``(3,)`` into one ``(6,)``."""
    joined: SixVector = _namespace(first, second).concatenate([first, second])
    return joined


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors ``(3,)``; much faster than `numpy.cross` for single
    vectors."""
    xp = _namespace(a, b)
    a0, a1, a2 = a
    b0, b1, b2 = b
    return xp.asarray([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def matrix(quaternion: Array) -> Array:
    """Return the rotation matrix ``(3, 3)`` from body to world axes."""
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
    """Return the product of two quaternions: the rotation by `b`, then by `a`."""
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
    """Return the inverse rotation."""
    return quaternion * _namespace(quaternion).asarray([1.0, -1.0, -1.0, -1.0])


def normalized(quaternion: Array) -> Array:
    """Return the quaternion scaled to length 1."""
    return quaternion / (quaternion @ quaternion) ** 0.5


def from_vector(vector: Array) -> Array:
    """Return the rotation about a vector by an angle equal to its length [rad]."""
    xp = _namespace(vector)
    # The small offset keeps the derivative finite at 0.
    half = xp.sqrt(vector @ vector + 1e-30) / 2
    return xp.concatenate([xp.cos(half)[None], vector * (xp.sin(half) / (2 * half))])


def to_vector(quaternion: Array) -> Array:
    """Return the rotation vector: axis times angle, with the angle in 0 .. pi [rad]."""
    xp = _namespace(quaternion)
    # q and -q are the same rotation: use the one with an angle of at most pi.
    quaternion = xp.where(quaternion[0] < 0, -quaternion, quaternion)
    sine = xp.sqrt(quaternion[1:] @ quaternion[1:] + 1e-30)
    return quaternion[1:] * (2 * xp.arctan2(sine, quaternion[0]) / sine)


def from_euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the rotation by yaw about z, then pitch about the new y, then roll about the new x
    [rad] (REP 103)."""
    x, y, z = map(from_vector, np.diag([roll, pitch, yaw]))
    return np.asarray(multiply(z, multiply(y, x)))
