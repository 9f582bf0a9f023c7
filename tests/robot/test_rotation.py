"""Rotations against SciPy's."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from softfin.robot.rotation import (
    from_euler,
    from_vector,
    inverse_rotation,
    matrix,
    multiply,
    to_vector,
)

Vectors = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array)


def peer(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quaternion, -1))


@given(Vectors, Vectors)
def test_rotations_are_scipy_s(a: np.ndarray, b: np.ndarray) -> None:
    one = from_vector(a)
    other = from_vector(b)
    np.testing.assert_allclose(matrix(one), Rotation.from_rotvec(a).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        matrix(multiply(one, other)), matrix(one) @ matrix(other), atol=1e-12
    )
    np.testing.assert_allclose(to_vector(one), peer(one).as_rotvec(), atol=1e-9)
    np.testing.assert_allclose(matrix(inverse_rotation(one)), matrix(one).T, atol=1e-12)


def test_euler_s_angles_are_those_of_rep_103() -> None:
    found = from_euler(0.3, -0.5, 2.0)
    np.testing.assert_allclose(
        matrix(found), Rotation.from_euler("ZYX", [2.0, -0.5, 0.3]).as_matrix(), atol=1e-12
    )
