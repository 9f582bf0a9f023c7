"""Configuration for ROS 2: the connection to other nodes, the topics of softfin's nodes, and the
topics of a fin."""

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

from softfin.control.feedback import FeedbackConfig
from softfin.core.choices import TransportName
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.quantities import Limits
from softfin.data.importing.importing import FORCE_FRAMES

TopicName = Annotated[str, StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")]
"""An absolute topic name, e.g. ``/fin/wrench``; relative names and ``~`` are not allowed."""

MessageType = Annotated[
    str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$")
]

LimitsField = Annotated[
    Limits,
    BeforeValidator(lambda value: value if isinstance(value, Limits) else Limits.of(value)),
    PlainSerializer(lambda limits: limits.to_dict()),
]


class TransportConfig(Configuration):
    """Connection to other nodes."""

    transport: TransportName = "auto"
    """rclpy needs ROS 2, but dds does not; auto: rclpy if it is installed."""
    # RTPS uses the UDP ports from 7400 + 250 * domain, so 232 is the largest domain.
    domain: int | None = Field(default=None, ge=0, le=232)
    """ROS domain (default: the environment variable ROS_DOMAIN_ID, or 0)."""
    network: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.:-]+$")
    """Network interface for DDS only, e.g. eth0 (default: this computer only)."""
    node: str = Field(default="softfin", pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")
    """Node name, used with rclpy."""

    def domain_id(self) -> int:
        """Return the configured domain, or the domain in the environment; raises RigError if the
        latter is invalid."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
        if not text.isdecimal() or int(text) > 232:
            raise RigError(
                f"ROS_DOMAIN_ID={text}: must be an integer from 0 to 232; correct it or unset it"
            )
        return int(text)


class NodeConfig(Configuration):
    """Topics and frames of the node; `softfin import-logs` looks for these names in a bag."""

    joint_topic: TopicName = "/fin/joint_states"
    """sensor_msgs/JointState for every sample: angle [rad], velocity [rad/s] and, if the motor
    current and the torque constant are known, effort: the torque of the motor [N m]."""
    wrench_topic: TopicName = "/fin/wrench"
    """geometry_msgs/WrenchStamped for every sample: force [N] and torque [N m] of the fin on its
    mount."""
    command_topic: TopicName = "/fin/command"
    """sensor_msgs/JointState for every new command: angle [rad] and profile velocity [rad/s]."""
    reference_topic: TopicName = "/fin/reference"
    """geometry_msgs/WrenchStamped: reference force (x, y) [N]."""
    stop_topic: TopicName = "/fin/stop"
    """std_msgs/Bool: true stops the fin; false does not cancel the stop."""
    current_topic: TopicName = "/fin/current"
    """std_msgs/Float64 for every sample whose motor current is known [A]."""
    joint_name: str = "fin"
    """Name of the joint in the messages."""
    frame: str = "fin_mount"
    """Frame of the forces; +x is forward thrust on the robot."""
    reference_timeout_s: PositiveFloat | None = 1.0
    """Age after which a reference expires [s]; None keeps the latest one forever."""
    reference_lost: Literal["keep", "zero", "stop"] = "keep"
    """Reaction to an expired reference. keep: return to --reference; zero: set the target to 0 N,
    at which the fin may still beat; stop: stop the fin."""
    reference_limit_n: PositiveFloat | None = None
    """Maximum reference on either axis [N]; larger ones are rejected. None: 20 N for a fin like the
    paper's, in proportion to the size of other fins, and at least the range of the controller."""

    feedback: FeedbackConfig | None = None
    """Feedback, which corrects the reference for changes of the fin; None for no feedback."""
    connection: TransportConfig = Field(default_factory=TransportConfig)
    """Connection to other nodes."""

    @classmethod
    def of_fin(cls, name: str) -> "NodeConfig":
        """Return the defaults for one fin of a robot: topics and frame under the name of the fin,
        and a stop if the robot node is lost."""
        if not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
            raise ConfigurationError(
                f"fin {name!r}: cannot be part of a topic name; use letters, digits and _, e.g. "
                "front_left, or ucat/front_left in a namespace"
            )
        connection = TransportConfig(node=name.replace("/", "_"))
        return cls(
            **fin_topics(name),
            frame=f"{name}/fin_mount",
            reference_lost="stop",
            connection=connection,
        )

    @model_validator(mode="after")
    def _check(self) -> "NodeConfig":
        check_names([value for name, value in self if name.endswith("_topic")])
        if self.reference_lost != "keep" and self.reference_timeout_s is None:
            raise ValueError(
                f"reference_lost = {self.reference_lost}: needs a timeout; set reference_timeout_s"
            )
        return self


def fin_topics(name: str, prefix: str = "") -> dict[str, str]:
    """Return the topics of the node of a fin, keyed by NodeConfig field name."""
    return {
        "joint_topic": f"{prefix}/{name}/joint_states",
        "wrench_topic": f"{prefix}/{name}/wrench",
        "command_topic": f"{prefix}/{name}/command",
        "reference_topic": f"{prefix}/{name}/reference",
        "stop_topic": f"{prefix}/{name}/stop",
        "current_topic": f"{prefix}/{name}/current",
    }


def check_names(topics: Sequence[str]) -> None:
    """Raise ValueError if two topics have the same name."""
    if twice := sorted({name for name in topics if topics.count(name) > 1}):
        raise ValueError(f"{', '.join(twice)} is used for two topics; use different names")


class FlipperConfig(Configuration):
    """Message that moves the flipper. Fields are specified by path, e.g. ``zero_direction`` or
    ``flippers.2.amplitude``."""

    type: MessageType
    """Message type, as package/msg/Type."""
    definitions: dict[MessageType, str] = Field(default_factory=dict)
    """Text of the .msg file of each type that is not part of ROS 2, keyed by package/msg/Type."""
    zero_direction: str = "zero_direction"
    """Field for the angle [rad]."""
    amplitude: str = "amplitude"
    """Field set to 0 so that the flipper does not oscillate by itself."""
    constants: dict[str, float | bool | str] = Field(default_factory=dict)
    """Values of other fields that must not be 0 or empty, e.g. a frequency or the flipper
    number."""
    rate_hz: float = Field(default=20.0, gt=0, le=100)
    """Message rate [Hz]."""


class Ros2PlantConfig(Configuration):
    """Topics of the fin; fields that depend on the robot have no default."""

    joint_topic: TopicName
    """sensor_msgs/JointState with the shaft angle, at 100 Hz or more."""
    joint_name: str = Field(min_length=1)
    """Name of the fin joint in the messages."""
    wrench_topic: TopicName
    """geometry_msgs/WrenchStamped of the fin on its mount, at 100 Hz or more; the driver must apply
    an anti-alias filter for 100 Hz."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """Sensor axes along softfin's +x (forward thrust on the robot) and +y, e.g. ``y,-x``."""
    command_topic: TopicName
    """sensor_msgs/JointState with position and velocity, or the flipper message."""
    flipper: FlipperConfig | None = None
    """Configuration for robots of the U-CAT family, whose commands are flipper messages."""
    negate_angle: bool = False
    """Whether the driver's angles, velocities and commands have the opposite sign."""
    limits: LimitsField
    """Range of accepted commands: angle_min_rad, angle_max_rad, velocity_min_rad_s,
    velocity_max_rad_s."""
    stop_topic: TopicName | None = None
    """std_msgs/Bool topic; on true, the driver must brake and disable its motor. None: a stop only
    commands the fin to hold its angle."""
    stop_release: bool = False
    """Whether to send false on the stop topic when the fin is enabled; use only if this cannot
    cancel a stop by a different program."""
    driver_delay_s: float = Field(default=0.15, ge=0, le=1)
    """Time by which the fin may lag behind its commands [s]: the delay of the driver plus its ramps
    (twice the velocity divided by the acceleration). Only a longer lag is treated as a following
    error."""
    wait_s: PositiveFloat = Field(default=5.0, le=120)
    """Maximum wait for the first messages [s]."""
    connection: TransportConfig = Field(default_factory=TransportConfig)
    """Connection to the driver."""

    def check_apart(self, node: NodeConfig) -> None:
        """Raise RigError if the node would publish on a topic of this fin, or would read its
        references from such a topic."""
        ours = {self.joint_topic, self.wrench_topic, self.command_topic, self.stop_topic}
        for name in (
            "joint_topic",
            "wrench_topic",
            "command_topic",
            "reference_topic",
            "current_topic",
        ):
            if (topic := getattr(node, name)) in ours:
                raise RigError(
                    f"{name} = {topic}: already a topic of the fin; use a different one: --set "
                    f"{name}=/NAME"
                )
