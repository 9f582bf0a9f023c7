"""One fin: its life-cycle node, and its frames from the robot description."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

SHARE = FindPackageShare("softfin_ros")


def generate_launch_description() -> LaunchDescription:
    """Return the node `softfin` and its robot_state_publisher in one namespace."""
    namespace = LaunchConfiguration("namespace")
    autostart = ParameterValue(LaunchConfiguration("autostart"), value_type=bool)
    urdf = PathJoinSubstitution([SHARE, "urdf", "fin.urdf.xacro"])
    parent = LaunchConfiguration("parent")
    description = Command(["xacro ", urdf, " parent:=", parent])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace", default_value="fin", description="Prefix of the topics"
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([SHARE, "config", "fin.yaml"]),
                description="YAML file with the parameters of the node",
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="false",
                description="Configure and activate the node; it moves the fin if arm is true",
            ),
            DeclareLaunchArgument(
                "wrench_topic",
                default_value="wrench",
                description="Use force_torque_sensor_broadcaster/wrench for nodes that expect the "
                "topic of ros2_control",
            ),
            DeclareLaunchArgument(
                "parent", default_value="base_link", description="Frame to which the mount is fixed"
            ),
            LifecycleNode(
                package="softfin_ros",
                executable="fin",
                name="softfin",
                namespace=namespace,
                parameters=[LaunchConfiguration("params_file"), {"autostart": autostart}],
                remappings=[("wrench", LaunchConfiguration("wrench_topic"))],
                output="screen",
            ),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                namespace=namespace,
                parameters=[{"robot_description": ParameterValue(description, value_type=str)}],
            ),
        ]
    )
