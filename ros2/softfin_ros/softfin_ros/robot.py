"""The node of a robot, which distributes wrenches among the nodes of its fins and moves nothing
itself."""

import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from softfin.core.errors import SoftfinError
from softfin.rig.ros2.rclpy import NodeTransport
from softfin.rig.session import in_one_line
from softfin.rig.stop import StopRequest, stopped_by_signals
from softfin.robot.description import load_robot
from softfin.robot.node_config import RobotNodeConfig
from softfin.stages.robot import run_robot
from softfin_ros import parameters
from softfin_ros.mounts import TF_MESSAGE, TF_STATIC_TOPIC, encode_mounts

TOPICS = ("reference", "wrench", "saturated", "stop")

FIELDS = {
    name: field
    for name, field in RobotNodeConfig.model_fields.items()
    if isinstance(field.default, str | float) and not name.endswith("_topic")
}
"""Fields that are parameters."""


def main() -> int:
    """Run the node until it is stopped, and return the exit code: 3 after a stop."""
    # softfin handles signals itself, because it must stop the fins first, and because a repeated
    # Ctrl-C must not change the exit code.
    signals = StopRequest()
    signals.is_obeyed = True
    with stopped_by_signals(signals):
        return _run(signals)


def _run(signals: StopRequest) -> int:
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("softfin_robot")
    parameters.declare(node, FIELDS)
    robot = node.declare_parameter("robot", "ucat").value
    max_thrust = node.declare_parameter("max_thrust", 0.0).value
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    transport = NodeTransport(node)
    # If the executor ends, the node can no longer hear its fins, so it stops them.
    threading.Thread(target=transport.spin, args=(executor,), daemon=True).start()
    try:
        values = parameters.read(node, FIELDS) | parameters.resolve(node, TOPICS)
        settings = RobotNodeConfig.build(values | {"max_thrust": max_thrust or None}, "parameters")
        body = load_robot(robot)
        mounts = transport.publish(TF_STATIC_TOPIC, TF_MESSAGE, latched=True)
        mounts.send(encode_mounts(body, settings.vehicle_frame_id))
        if signals.trip is None:
            run_robot(transport, body, settings)
    except Exception as error:
        # A node that has sent references has also sent a stop to every fin by now.
        node.get_logger().error(in_one_line(error, "the node of the robot failed"))
        return error.exit_code if isinstance(error, SoftfinError) else 1
    finally:
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
