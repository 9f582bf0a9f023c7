import numpy as np
import pytest

from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig.machine import rotated, rotation


@pytest.mark.parametrize("frame", FORCE_FRAMES)
def test_every_frame_is_a_rotation(frame):
    turn = rotation(frame)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1)


def test_a_frame_says_what_is_x_and_what_is_y_in_the_sensors_axes():
    np.testing.assert_allclose(rotation("y,-x") @ [1.0, 2.0, 3.0], [2.0, -1.0, 3.0])
    np.testing.assert_allclose(rotation("y,x") @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0])


@pytest.mark.parametrize("frame", FORCE_FRAMES)
def test_the_frame_of_a_force_is_a_rotation_of_force_and_torque_alike(frame):
    wrench = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    x, y = ("xy".index(term[-1]) for term in frame.split(","))
    signs = [-1.0 if term.startswith("-") else 1.0 for term in frame.split(",")]
    result = rotated(wrench, rotation(frame))
    assert result[:2] == (signs[0] * wrench[x], signs[1] * wrench[y])
    assert result[3:5] == (signs[0] * wrench[3 + x], signs[1] * wrench[3 + y])
    lever = np.array([0.3, -0.2, 0.5])
    force = np.array([1.0, 2.0, 3.0])
    applied = rotated((*force.tolist(), *np.cross(lever, force).tolist()), rotation(frame))
    moved = rotation(frame) @ lever
    np.testing.assert_allclose(applied[3:], np.cross(moved, applied[:3]), atol=1e-12)
