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
    """auto: rclpy where it is installed, else DDS."""
    domain: int | None = Field(default=None, ge=0, le=232)
    """ROS domain; None takes the variable ROS_DOMAIN_ID, else 0."""
    network: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.:-]+$")
    """Network interface that DDS uses, as eth0; None is this computer alone. rclpy takes ROS's own
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
    """std_msgs/Bool: true stops the fin; false does not take that back."""
    joint_name: str = "fin"
    """Name of the joint in the messages."""
    frame: str = "fin_mount"
    """Frame of the forces: +x is thrust that pushes the robot forward."""
    reference_timeout_s: PositiveFloat | None = 1.0
    """Age beyond which a reference does not count any more [s]; None obeys the newest for ever."""
    reference_lost: Literal["keep", "zero", "stop"] = "keep"
    """Reaction to a reference that came and is too old. keep: --reference holds again; zero: the
    target is 0 N, for which the fin may beat all the same; stop: the fin is stopped."""
    reference_limit_n: PositiveFloat = Field(default=20.0)
    """A reference beyond this on either axis is refused [N]: twice what a fin like the paper's can
    make."""

    connection: TransportConfig = Field(default_factory=TransportConfig)
    """How to reach other nodes."""

    @classmethod
    def of_fin(cls, name: str) -> "NodeConfig":
        """Return the defaults for one fin of a robot: topics under its name, and a stop if its
        robot's node is lost."""
        if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            raise ConfigurationError(
                f"fin {name!r}: cannot be in the name of a topic; use letters, digits and _, as "
                "front_left, or ucat/front_left in a namespace"
            )
        connection = TransportConfig(node=name.replace("/", "_"))
        return cls(**fin_topics(name), reference_lost="stop", connection=connection)

    @model_validator(mode="after")
    def _check(self) -> "NodeConfig":
        check_names([value for name, value in self if name.endswith("_topic")])
        if self.reference_lost != "keep" and self.reference_timeout_s is None:
            raise ValueError(
                f"reference_lost = {self.reference_lost}: needs an age; set reference_timeout_s"
            )
        return self


class RobotNodeConfig(Configuration):
    """Topics of a robot's node, its frame, and what its fins can make.

    `vehicle_frame_id` and `max_thrust` mean what they mean in auv_controllers; its allocation
    matrix (`tam`) and names (`thrusters`) follow from the robot's file here.
    """

    reference_topic: TopicName = "/robot/reference"
    """geometry_msgs/WrenchStamped: the wrench that is asked for, force [N] and torque [N m] about
    the origin."""
    wrench_topic: TopicName = "/robot/wrench"
    """geometry_msgs/WrenchStamped: the wrench that the fins' references make together."""
    saturated_topic: TopicName = "/robot/saturated"
    """std_msgs/Bool: some of the wrench that is asked for is beyond the fins."""
    stop_topic: TopicName = "/robot/stop"
    """std_msgs/Bool: true stops every fin, and this node; false does not take that back."""
    vehicle_frame_id: str = "base_link"
    """Frame of both wrenches: x forward, y left, z up (REP 103)."""
    fin_prefix: str = Field(default="", pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)*$")
    """Namespace of the fins, as /ucat: the topics of each are PREFIX/NAME/reference, /joint_states
    and /stop."""
    max_thrust: PositiveFloat | dict[str, PositiveFloat] | None = None
    """Greatest mean force that a fin makes in every direction [N]: one number, or one for each fin
    by name. Required: it is of your fins, and of their controllers."""
    reference_timeout_s: PositiveFloat = 1.0
    """Age beyond which a wrench does not count any more [s]."""
    reference_lost: Literal["zero", "stop"] = "stop"
    """Reaction to a wrench that came and is too old. zero: the fins are asked for no force; stop:
    every fin is stopped, and this node."""
    fin_timeout_s: PositiveFloat = 0.5
    """Silence of a fin's joint_states beyond which it counts as silent [s]."""
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
        raise ValueError(f"{', '.join(twice)} is the name of two topics; give each its own")


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
    """The driver's angles, velocities and commands count the other way round."""
    limits: LimitsField
    """The commands that the fin accepts: angle_min_rad, angle_max_rad, velocity_min_rad_s,
    velocity_max_rad_s."""
    stop_topic: TopicName | None = None
    """std_msgs/Bool that the driver brakes and disables its motor on. None: a stop is a command to
    hold."""
    stop_release: bool = False
    """Send false on the stop topic when the fin is enabled: only where that takes back nobody
    else's stop."""
    driver_delay_s: float = Field(default=0.15, ge=0, le=1)
    """Time by which the fin may follow its commands late [s]: the driver's delay, and its ramps:
    two velocities divided by the acceleration. Only what lags behind for longer is a following
    error."""
    best_effort: bool = True
    """Read joint and wrench as sensor data: it matches every publisher, and a lost reading is not
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
                    f"{name} = {topic}: is a topic of the fin's own; give another: --set "
                    f"{name}=/NAME"
                )
