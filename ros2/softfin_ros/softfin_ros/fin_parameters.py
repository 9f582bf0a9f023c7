"""Parameters of the node of one fin, and the controller and topics that they describe. Does not
import rclpy."""

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import Force
from softfin.rig.arming import Arming
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.connection import Transport
from softfin.rig.ros2.inputs import EmergencyStop
from softfin.rig.ros2.plant import Ros2Machine
from softfin.stages.driving import Drive, NodeDrive


class FinParameters(Configuration):
    """Parameters of the node; ROS 2 has no None, so 0 and empty texts replace it."""

    controller: str = ""
    """Controller folder."""
    plant: str = "rig"
    """The fin: rig or ros2, optionally followed by :FILE."""
    reference: Force = (0.0, 0.0)
    """Reference force (x, y) before the first message, and after an expired one if `reference_lost`
    is keep [N]."""
    strict: bool = False
    """Reject unreachable references instead of tracking the nearest reachable one."""
    feedback: bool = False
    """Add feedback from force and torque, which corrects for changes of the fin."""
    folder: str = "."
    """Folder of the recordings; each activation writes one."""
    arm: bool = False
    """Allow the real fin to move when the node is activated."""
    autostart: bool = False
    """Configure and activate the node when it starts."""
    joint_name: str = "fin"
    """Name of the joint in the messages."""
    frame: str = "fin_mount"
    """Frame of the forces; +x is forward thrust on the robot."""
    reference_timeout_s: float = Field(default=1.0, ge=0)
    """Age after which a reference expires [s]; 0: never."""
    reference_lost: Literal["keep", "zero", "stop"] = "stop"
    """Reaction to an expired reference, as in `NodeConfig`."""
    reference_limit_n: float = Field(default=0.0, ge=0)
    """Maximum reference on either axis [N]; 0: the default of `NodeConfig`."""

    def node_config(self, topics: Mapping[str, str]) -> NodeConfig:
        """Return the configuration of the node with these topics, keyed by field name."""
        return NodeConfig.build(
            {
                **topics,
                "joint_name": self.joint_name,
                "frame": self.frame,
                "reference_timeout_s": self.reference_timeout_s or None,
                "reference_lost": self.reference_lost,
                "reference_limit_n": self.reference_limit_n or None,
                "feedback": {} if self.feedback else None,
            },
            "parameters",
        )

    def connect(
        self, transport: Transport, topics: Mapping[str, str], emergency_stop: EmergencyStop
    ) -> NodeDrive:
        """Load the controller and create the topics."""
        if not self.controller:
            raise ConfigurationError("parameter controller: missing; set it to a controller folder")
        config = self.node_config(topics)
        # The activation of the node confirms the motion, because launch files have no terminal.
        arming = Arming(self.arm, yes=True)
        drive = Drive.prepare(
            self.controller, self.plant, arming, None, None, config.feedback, overwrite=False
        )
        machine = drive.robot.machine
        if isinstance(machine, Ros2Machine) and machine.config.stop_topic == config.stop_topic:
            raise ConfigurationError(
                f"stop topic {config.stop_topic}: also used by the driver, so each deactivation "
                "would stop this node; remap the stop topic of this node"
            )
        return NodeDrive.connect(
            drive, transport, config, self.reference, self.strict, emergency_stop
        )
