"""Configuration of the ROS 2 node of a robot: topics, frame, and forces of the fins."""

from typing import Literal

from pydantic import Field, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.rig.ros2.config import TopicName, TransportConfig
from softfin.robot.description import MaxThrust


class RobotNodeConfig(Configuration):
    """Topics and frame of the node of a robot, and forces of the fins.

    `vehicle_frame_id` and `max_thrust` have the same meaning as in auv_controllers; the allocation
    matrix (`tam`) and names (`thrusters`) of that package are derived from the robot file here.
    """

    reference_topic: TopicName = "/robot/reference"
    """geometry_msgs/WrenchStamped: target wrench, with force [N] and torque about the origin [N
    m]."""
    wrench_topic: TopicName = "/robot/wrench"
    """geometry_msgs/WrenchStamped: total wrench of the fin references."""
    saturated_topic: TopicName = "/robot/saturated"
    """std_msgs/Bool: true if part of the target wrench is out of reach."""
    stop_topic: TopicName = "/robot/stop"
    """std_msgs/Bool: true stops every fin and this node; false does not cancel the stop."""
    vehicle_frame_id: str = "base_link"
    """Frame of both wrenches: x forward, y left, z up (REP 103)."""
    fin_prefix: str = Field(default="", pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")
    """Namespace of the fins, e.g. /ucat; the topics of each fin are PREFIX/NAME/reference,
    /joint_states and /stop."""
    max_thrust: MaxThrust | None = None
    """Maximum mean force that each fin can produce in every direction [N]: one number for all, or
    one per fin name. Required, because it depends on your fins and their controllers."""
    reference_timeout_s: PositiveFloat = 1.0
    """Age after which a wrench expires [s]."""
    reference_lost: Literal["zero", "stop"] = "stop"
    """Reaction to an expired wrench. zero: set the target force of every fin to 0 N; stop: stop
    every fin and this node."""
    fin_timeout_s: PositiveFloat = 0.5
    """Time without joint_states after which a fin counts as silent [s]."""
    wait_s: PositiveFloat = Field(default=60.0, le=600)
    """Maximum wait for all fins at the start [s]."""
    connection: TransportConfig = Field(
        default_factory=lambda: TransportConfig(node="softfin_robot")
    )
    """How to reach other nodes."""
