"""``softfin ros2``: a controller on the real fin as a ROS 2 node: readings out, references and a stop in; no JAX."""

import functools
from dataclasses import dataclass

from softfin.cli.common import Configured
from softfin.cli.driving import Driving, say
from softfin.cli.kinds import Force
from softfin.control.references import resolve_reference
from softfin.core.choices import TransportName
from softfin.core.errors import RigError
from softfin.rig.machine import clock_of
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.node import RosNode
from softfin.rig.ros2.plant import Ros2Machine, open_transport
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.stop import StopRequest


@dataclass(frozen=True, kw_only=True)
class Arguments(Driving, Configured):
    """Run as a ROS 2 node: hold the reference of a topic on the real fin, publish each sample; Enter or a topic stops.

    Topics, frames and the timeout of references: --set joint_topic=/NAME and so on (docs/rig.md has them all).
    """

    reference: Force
    """Reference force as --reference=X,Y in newton, while no other comes: at first, and when the last is too old."""
    transport: TransportName | None = None
    """auto: rclpy where it is installed, else DDS without ROS 2."""
    domain: int | None = None
    """ROS domain (the variable ROS_DOMAIN_ID, else 0)."""
    network: str | None = None
    """With DDS: the network interface, as eth0, whose others may read and write the topics; else this computer alone.
    """

    def run(self) -> None:
        """Run."""
        options = {"transport": self.transport, "domain": self.domain, "network": self.network}
        given = {name: value for name, value in options.items() if value is not None}
        topics = self.configured(NodeConfig(), connection=given or None)
        controller, robot = self.parties()
        if isinstance(clock_of(robot.machine), SimulatedClock):
            raise RigError(
                f"{robot.machine.name}: emulated in simulated time, in which no topic can be heard; start "
                "softfin rig emulate --real-time"
            )
        if isinstance(robot.machine, Ros2Machine):
            robot.machine.config.check_apart(topics)
        otherwise, warning = resolve_reference(controller, self.reference, self.strict)
        transport = open_transport(topics.connection)
        try:
            node = RosNode(transport, topics, say, lambda asked: resolve_reference(controller, asked, self.strict))
            for note in (*transport.notes, *([] if warning is None else [warning])):
                say(note)
            stop = StopRequest()
            result = self.drive(
                controller, robot, lambda _: node.reference() or otherwise, self.seconds,
                lambda _: say("references come by their topic; Enter alone stops the fin"), stop,
                (functools.partial(node.observe, stop),),
            )  # fmt: skip
            result["counters"] |= node.counters()
        finally:
            transport.close()
        self.tell_errors(result)
