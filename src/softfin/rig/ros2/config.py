"""Configuration of ROS 2: how to reach other nodes, the topics of softfin's nodes, the topics of a
fin."""

import os
import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    PositiveFloat,
    StringConstraints,
    model_validator,
)

from softfin.core.choices import TransportName
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.quantities import Limits
from softfin.data.importing.importing import FORCE_FRAMES

TopicName = Annotated[str, StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")]
"""A full name, as ``/fin/wrench``: no relative ones, no ``~``."""

MessageType = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$")
]

LimitsField = Annotated[
    Limits,
    BeforeValidator(lambda value: value if isinstance(value, Limits) else Limits.of(value)),
    PlainSerializer(lambda limits: limits.to_dict()),
]


class TransportConfig(Configuration):
    """How to reach other nodes."""

    transport: TransportName = "auto"
    """auto: rclpy if it is installed, otherwise DDS."""
    domain: int | None = Field(default=None, ge=0, le=232)
    """ROS domain; None uses the environment variable ROS_DOMAIN_ID, or 0 if it is not set."""
    network: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.:-]+$")
    """Network interface for DDS, such as eth0; None for this computer only. rclpy uses ROS's own
    settings."""
    node: str = Field(default="softfin", pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")
    """Name of the node, with rclpy."""

    def domain_id(self) -> int:
        """The domain, from the environment where it is not configured; raises RigError."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
        if not text.isdecimal() or int(text) > 232:
            raise RigError(
                f"ROS_DOMAIN_ID={text}: a domain is a whole number from 0 to 232; correct it or "
                "unset it"
            )
        return int(text)


class NodeConfig(Configuration):
    """Topics and frames of the node; the names are those that `softfin import-logs` looks for in a
    bag."""

    joint_topic: TopicName = "/fin/joint_states"
    """sensor_msgs/JointState of every sample: angle [rad] and velocity [rad/s]."""
    wrench_topic: TopicName = "/fin/wrench"
    """geometry_msgs/WrenchStamped of every sample: force [N] and torque [N m] of the fin on its
    mount."""
    command_topic: TopicName = "/fin/command"
    """sensor_msgs/JointState of every new command: angle and profile velocity."""
    reference_topic: TopicName = "/fin/reference"
    """The reference force, x and y [N]."""
    reference_type: Literal["wrench", "vector3"] = "wrench"
    """Type of the message: geometry_msgs/WrenchStamped or geometry_msgs/Vector3Stamped."""
    stop_topic: TopicName = "/fin/stop"
    """std_msgs/Bool: true stops the fin; false does not cancel the stop."""
    joint_name: str = "fin"
    """Name of the joint in the messages."""
    frame: str = "fin_mount"
    """Frame of the forces: +x is thrust that pushes the robot forward."""
    reference_timeout_s: PositiveFloat | None = 1.0
    """Age after which a reference expires [s]; None keeps the newest one forever."""
    reference_lost: Literal["keep", "zero", "stop"] = "keep"
    """Reaction to an expired reference. keep: go back to --reference; zero: set the target to 0 N,
    for which the fin may still beat; stop: stop the fin."""
    reference_limit_n: PositiveFloat = Field(default=20.0)
    """Largest reference on either axis; others are refused [N]. The default is twice what a fin
    like the paper's can produce."""

    connection: TransportConfig = Field(default_factory=TransportConfig)
    """How to reach other nodes."""

    @classmethod
    def of_fin(cls, name: str) -> "NodeConfig":
        """Return the defaults for one fin of a robot: topics under its name, and a stop if its
        robot's node is lost."""
        if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            raise ConfigurationError(
                f"fin {name!r}: cannot be part of a topic name; use letters, digits and _, such as "
                "front_left, or ucat/front_left in a namespace"
            )
        connection = TransportConfig(node=name.replace("/", "_"))
        return cls(**fin_topics(name), reference_lost="stop", connection=connection)

    @model_validator(mode="after")
    def _check(self) -> "NodeConfig":
        check_names([value for name, value in self if name.endswith("_topic")])
        if self.reference_lost != "keep" and self.reference_timeout_s is None:
            raise ValueError(
                f"reference_lost = {self.reference_lost}: needs a timeout; set reference_timeout_s"
            )
        return self


class RobotNodeConfig(Configuration):
    """Topics of a robot's node, its frame, and what its fins can make.

    `vehicle_frame_id` and `max_thrust` mean what they mean in auv_controllers; its allocation
    matrix (`tam`) and names (`thrusters`) follow from the robot's file here.
    """

    reference_topic: TopicName = "/robot/reference"
    """geometry_msgs/WrenchStamped: the target wrench, force [N] and torque [N m] about the
    origin."""
    wrench_topic: TopicName = "/robot/wrench"
    """geometry_msgs/WrenchStamped: the wrench that the fins' references make together."""
    saturated_topic: TopicName = "/robot/saturated"
    """std_msgs/Bool: true if a part of the target wrench is beyond the fins' reach."""
    stop_topic: TopicName = "/robot/stop"
    """std_msgs/Bool: true stops every fin and this node; false does not cancel the stop."""
    vehicle_frame_id: str = "base_link"
    """Frame of both wrenches: x forward, y left, z up (REP 103)."""
    fin_prefix: str = Field(default="", pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")
    """Namespace of the fins, as /ucat: the topics of each are PREFIX/NAME/reference, /joint_states
    and /stop."""
    max_thrust: PositiveFloat | dict[str, PositiveFloat] | None = None
    """Maximum mean force that a fin produces in every direction [N]: one number, or one per fin
    name. Required, because it depends on your fins and their controllers."""
    reference_timeout_s: PositiveFloat = 1.0
    """Age after which a wrench expires [s]."""
    reference_lost: Literal["zero", "stop"] = "stop"
    """Reaction to an expired wrench. zero: set the target force of every fin to 0 N; stop: stop
    every fin and this node."""
    fin_timeout_s: PositiveFloat = 0.5
    """Time without joint_states after which a fin counts as silent [s]."""
    wait_s: PositiveFloat = Field(default=60.0, le=600)
    """Longest wait for all fins at the start [s]."""
    connection: TransportConfig = Field(
        default_factory=lambda: TransportConfig(node="softfin_robot")
    )
    """How to reach other nodes."""


def fin_topics(name: str, prefix: str = "") -> dict[str, str]:
    """Return the topics of the node of a robot's fin, by their names in NodeConfig."""
    return {
        "joint_topic": f"{prefix}/{name}/joint_states",
        "wrench_topic": f"{prefix}/{name}/wrench",
        "command_topic": f"{prefix}/{name}/command",
        "reference_topic": f"{prefix}/{name}/reference",
        "stop_topic": f"{prefix}/{name}/stop",
    }


def check_names(topics: Sequence[str]) -> None:
    """Raise ValueError where two topics have one name."""
    if twice := sorted({name for name in topics if topics.count(name) > 1}):
        raise ValueError(f"{', '.join(twice)} is used for two topics; give each its own name")


class FlipperConfig(Configuration):
    """Message that moves the flipper. A field is named by its path: ``zero_direction``,
    ``flippers.2.amplitude``."""

    type: MessageType
    """Type of the message: package/msg/Type."""
    definitions: dict[MessageType, str] = Field(default_factory=dict)
    """Text of the .msg file of each type that ROS 2 itself does not have, by package/msg/Type."""
    zero_direction: str = "zero_direction"
    """Field that takes the angle [rad]."""
    amplitude: str = "amplitude"
    """Field that takes 0: the flipper does not oscillate by itself."""
    constants: dict[str, float | bool | str] = Field(default_factory=dict)
    """Other fields that must not be 0 or empty, such as a frequency or the flipper's number."""
    rate_hz: float = Field(default=20.0, gt=0, le=100)
    """Messages a second [Hz]."""


class Ros2PlantConfig(Configuration):
    """Topics of the fin. What depends on the robot has no default."""

    joint_topic: TopicName
    """sensor_msgs/JointState with the shaft's angle, at 100 Hz or more."""
    joint_name: str = Field(min_length=1)
    """The fin's name in it."""
    wrench_topic: TopicName
    """geometry_msgs/WrenchStamped of the fin on its mount, at 100 Hz or more, filtered for 100 Hz
    by its driver."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """softfin's +x (thrust that pushes the robot forward) and +y, in the sensor's own axes:
    ``y,-x``."""
    command_topic: TopicName
    """sensor_msgs/JointState with position and velocity, or the flipper's message."""
    flipper: FlipperConfig | None = None
    """Configuration for robots of the U-CAT family: commands as flipper messages."""
    negate_angle: bool = False
    """Whether the driver's angles, velocities and commands have the opposite sign."""
    limits: LimitsField
    """The commands that the fin accepts: angle_min_rad, angle_max_rad, velocity_min_rad_s,
    velocity_max_rad_s."""
    stop_topic: TopicName | None = None
    """std_msgs/Bool on which the driver brakes and disables its motor. None: a stop is a command to
    hold."""
    stop_release: bool = False
    """Send false on the stop topic when the fin is enabled; use it only if that cannot cancel
    another program's stop."""
    driver_delay_s: float = Field(default=0.15, ge=0, le=1)
    """Time by which the fin may lag behind its commands [s]: the driver's delay plus its ramps
    (twice the velocity divided by the acceleration). Only a longer lag is a following error."""
    best_effort: bool = True
    """Read joint and wrench as sensor data: this matches every publisher, and lost readings are not
    sent again."""
    wait_s: PositiveFloat = Field(default=5.0, le=120)
    """Longest wait for the first messages [s]."""
    connection: TransportConfig = Field(default_factory=TransportConfig)
    """How to reach the driver."""

    def check_apart(self, node: NodeConfig) -> None:
        """Raise RigError where the node would publish on a topic of this fin, or take one for a
        reference."""
        ours = {self.joint_topic, self.wrench_topic, self.command_topic, self.stop_topic}
        for name in ("joint_topic", "wrench_topic", "command_topic", "reference_topic"):
            if (topic := getattr(node, name)) in ours:
                raise RigError(
                    f"{name} = {topic}: already a topic of the fin; use another: --set {name}=/NAME"
                )
