import numpy as np
import pytest

from softfin.rig.ros2.config import NodeConfig
from softfin.robot.description import FinMountConfig, load_robot
from softfin_ros.mounts import TF_MESSAGE, encode_mounts, quaternion
from tests.rig.ros2_memory import Messages


def test_the_mounts_are_frames_of_the_fin_nodes_in_the_frame_of_the_robot():
    robot = load_robot("ucat")
    message = Messages().decode(encode_mounts(robot, "base_link"), TF_MESSAGE)
    assert len(message.transforms) == len(robot.fins)
    for transform in message.transforms:
        name = transform.child_frame_id.removesuffix("/fin_mount")
        assert transform.header.frame_id == "base_link"
        assert transform.child_frame_id == NodeConfig.of_fin(name).frame
        translation = transform.transform.translation
        assert (translation.x, translation.y, translation.z) == robot.fins[name].position_m
        rotation = transform.transform.rotation
        turn = [rotation.x, rotation.y, rotation.z, rotation.w]
        assert turn == quaternion(robot.fins[name])


def rotate(turn, vector):
    """Rotate a vector, by the formula of Rodrigues for quaternions."""
    axis = np.array(turn[:3])
    return vector + 2 * np.cross(axis, np.cross(axis, vector) + turn[3] * np.array(vector))


def test_the_quaternion_of_a_fin_turns_its_axes_into_those_of_the_body():
    # Half turns about each axis have the trace -1, where formulas with the trace fail.
    half_turns = [
        FinMountConfig(position_m=(0, 0, 0), zero_direction=x, shaft_axis=s)
        for x, s in (
            ((1, 0, 0), (0, 0, 1)),
            ((-1, 0, 0), (0, 0, 1)),
            ((-1, 0, 0), (0, 0, -1)),
            ((0, 1, 0), (1, 0, 0)),
        )
    ]
    for mount in (*load_robot("ucat").fins.values(), *half_turns):
        turn = quaternion(mount)
        assert np.linalg.norm(turn) == pytest.approx(1.0)
        x, y = mount.axes().T
        assert rotate(turn, (1.0, 0.0, 0.0)) == pytest.approx(x)
        assert rotate(turn, (0.0, 1.0, 0.0)) == pytest.approx(y)
        shaft = np.negative(mount.shaft_axis)
        assert rotate(turn, (0.0, 0.0, 1.0)) == pytest.approx(shaft)
