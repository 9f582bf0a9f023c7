"""Stand-ins for what the package in ros2/ imports of ROS 2, which is not to be had here: they note
how they are called, after the documentation of rclpy, launch and launch_ros."""

import sys
import types

from tests.rig.ros2_memory import MemoryTransport


def module(patches, name, **members):
    made = types.ModuleType(name)
    made.__dict__.update(members)
    patches.setitem(sys.modules, name, made)


class Action:
    """A launch action, an event handler or a substitution: its arguments."""

    def __init__(self, *values, **named):
        self.values = values
        self.named = named


def kind(name):
    return type(name, (Action,), {})


class LaunchConfiguration(kind("LaunchConfiguration")):
    def perform(self, context):
        return context[self.values[0]]


LAUNCH = {
    "launch": ("LaunchDescription", "LaunchContext"),
    "launch.actions": (
        "DeclareLaunchArgument",
        "ExecuteProcess",
        "IncludeLaunchDescription",
        "OpaqueFunction",
        "RegisterEventHandler",
    ),
    "launch.event_handlers": ("OnProcessExit", "OnProcessIO"),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
    "launch.substitutions": ("Command", "PathJoinSubstitution"),
    "launch_ros": (),
    "launch_ros.actions": ("LifecycleNode", "Node"),
    "launch_ros.parameter_descriptions": ("ParameterValue",),
    "launch_ros.substitutions": ("FindPackageShare",),
}


def install_launch(patches):
    for name, members in LAUNCH.items():
        module(patches, name, **{member: kind(member) for member in members})
    sys.modules["launch.substitutions"].LaunchConfiguration = LaunchConfiguration


class LifecycleNode:
    """A node with parameters, whose transitions call the same methods as those of rclpy."""

    given = types.MappingProxyType({})
    """Parameters of the file, over the declared defaults."""
    namespace = "/tail"

    def __init__(self, name):
        self.name = name
        self.services = {}
        self.groups = {}
        self.timers = []
        self.errors = []
        self.descriptions = {}
        self.values = {}

    def declare_parameter(self, name, value, descriptor=None):
        self.values[name] = self.given.get(name, value)
        self.descriptions[name] = descriptor
        return self.get_parameter(name)

    def get_parameter(self, name):
        return types.SimpleNamespace(value=self.values[name])

    def get_namespace(self):
        return self.namespace

    def get_name(self):
        return self.name

    def get_logger(self):
        return types.SimpleNamespace(error=self.errors.append)

    def resolve_topic_name(self, name):
        return f"{self.namespace}/{name}"

    def create_service(self, service, name, answer, callback_group=None):
        self.services[name] = answer
        self.groups[name] = callback_group

    def create_timer(self, period_s, check):
        self.timers.append(check)

    def trigger_configure(self):
        return self.on_configure(None)

    def trigger_activate(self):
        return self.on_activate(None)

    def trigger_deactivate(self):
        return self.on_deactivate(None)


class NodeTransport(MemoryTransport):
    """The transport of softfin over a node, in memory."""

    def __init__(self, node, callback_group=None):
        super().__init__()
        self.callback_group = callback_group


def install_rclpy(patches):
    returned = types.SimpleNamespace(SUCCESS="success", FAILURE="failure")
    trigger = types.SimpleNamespace(Request=None, Response=None)
    module(patches, "rclpy")
    module(patches, "rclpy.callback_groups", MutuallyExclusiveCallbackGroup=kind("Group"))
    module(patches, "rclpy.executors", MultiThreadedExecutor=None, SingleThreadedExecutor=None)
    module(
        patches,
        "rclpy.lifecycle",
        LifecycleNode=LifecycleNode,
        TransitionCallbackReturn=returned,
    )
    module(patches, "rclpy.node", Node=LifecycleNode)
    module(patches, "rclpy.signals", SignalHandlerOptions=None)
    module(patches, "rcl_interfaces.msg", ParameterDescriptor=lambda description: description)
    module(patches, "std_srvs.srv", Trigger=trigger)
