"""Frames of the fins of a robot, for tf."""

import numpy as np

from softfin.rig.ros2.config import NodeConfig
from softfin.robot.description import FinMountConfig, RobotConfig
from softfin.storage.bag.messages import serialized

TF_STATIC_TOPIC = "/tf_static"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"


def encode_mounts(robot: RobotConfig, vehicle_frame_id: str) -> bytes:
    """Return the transforms from the frames of the fin nodes to the frame of the vehicle, as
    tf2_msgs/TFMessage."""
    fields: dict[str, object] = {}
    for index, (name, mount) in enumerate(robot.fins.items()):
        path = f"transforms.{index}"
        fields[f"{path}.header.frame_id"] = vehicle_frame_id
        fields[f"{path}.child_frame_id"] = NodeConfig.of_fin(name).frame
        for axis, value in zip("xyz", mount.position_m, strict=True):
            fields[f"{path}.transform.translation.{axis}"] = value
        for axis, value in zip("xyzw", quaternion(mount), strict=True):
            fields[f"{path}.transform.rotation.{axis}"] = value
    return serialized(TF_MESSAGE, fields)


def quaternion(mount: FinMountConfig) -> list[float]:
    """Return the rotation from the frame of the fin to body axes as x, y, z, w; the z axis of
    the fin points against its shaft."""
    forward, sideways = mount.axes().T
    turn = np.stack([forward, sideways, np.cross(forward, sideways)], axis=1)
    # Bar-Itzhack's method: the eigenvector of the largest eigenvalue of this matrix is the
    # quaternion. Unlike the formulas with the trace, it has no special cases.
    antisymmetric = turn - turn.T
    axis = np.array([antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]])
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = turn + turn.T - np.trace(turn) * np.eye(3)
    matrix[:3, 3] = axis
    matrix[3, :3] = axis
    matrix[3, 3] = np.trace(turn)
    largest: list[float] = np.linalg.eigh(matrix)[1][:, -1].tolist()
    return largest
