"""A robot with several fins: one life-cycle node per fin, and the node that distributes wrenches
among them."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

SHARE = FindPackageShare("softfin_ros")


def generate_launch_description() -> LaunchDescription:
    """Return the nodes of the fins, their frames and the node of the robot."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "robot", default_value="ucat", description="Name of a robot, or its YAML file"
            ),
            DeclareLaunchArgument(
                "fins",
                default_value="front_right back_right back_left front_left",
                description="Names of the fins in the file of the robot",
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([SHARE, "config", "robot.yaml"]),
                description="YAML file with the parameters of all nodes",
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="false",
                description="Configure and activate the fins; they move if arm is true",
            ),
            OpaqueFunction(function=fins),
            Node(
                package="softfin_ros",
                executable="robot",
                name="softfin_robot",
                namespace="robot",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"robot": LaunchConfiguration("robot")},
                ],
                output="screen",
            ),
        ]
    )


def fins(context: LaunchContext) -> list[Node]:
    """Return the nodes of each fin; the robot node publishes the transforms to the mounts."""
    names = LaunchConfiguration("fins").perform(context).split()
    return [node for name in names for node in (fin(name), frames(name))]


def fin(name: str) -> LifecycleNode:
    """Return the life-cycle node of one fin."""
    autostart = ParameterValue(LaunchConfiguration("autostart"), value_type=bool)
    return LifecycleNode(
        package="softfin_ros",
        executable="fin",
        name="softfin",
        namespace=name,
        parameters=[
            LaunchConfiguration("params_file"),
            {"autostart": autostart, "frame": f"{name}/fin_mount"},
        ],
        output="screen",
    )


def frames(name: str) -> Node:
    """Return the publisher of the frames of one fin."""
    urdf = PathJoinSubstitution([SHARE, "urdf", "fin.urdf.xacro"])
    description = ParameterValue(Command(["xacro ", urdf]), value_type=str)
    return Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        namespace=name,
        parameters=[{"robot_description": description, "frame_prefix": f"{name}/"}],
    )
