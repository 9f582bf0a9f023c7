"""Stand-ins for what the package in ros2/ imports of ROS 2, which is not to be had here: they note
how they are called, after the documentation of rclpy, launch and launch_ros.

That of rclpy has the rules on which the safety of a node depends: only the transitions of the life
cycle are possible, callbacks of one group wait for each other, readers keep as many messages as
they asked for, and an error in a callback ends the executor.
"""

import contextlib
import importlib
import sys
import threading
import types
from collections import defaultdict

from tests.rig.ros2_memory import Messages


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


class Group:
    """A MutuallyExclusiveCallbackGroup: its callbacks wait for each other."""

    def __init__(self):
        self.lock = threading.RLock()


SUCCESS = "success"
FAILURE = "failure"
ERROR = "error"

TRANSITIONS = {
    ("unconfigured", "configure"): "inactive",
    ("inactive", "activate"): "active",
    ("active", "deactivate"): "inactive",
    ("inactive", "cleanup"): "unconfigured",
    ("unconfigured", "shutdown"): "finalized",
    ("inactive", "shutdown"): "finalized",
    ("active", "shutdown"): "finalized",
}
"""Goal of each transition that is possible in a state."""


class LifecycleNode:
    """A node with parameters, topics and the state machine of the life cycle."""

    given = types.MappingProxyType({})
    """Parameters of the file, over the declared defaults."""
    namespace = "/tail"
    made = ()
    """All nodes, in the order of their creation."""

    def __init__(self, name):
        self.name = name
        self.state = "unconfigured"
        self.group = Group()
        """The default group: transitions, parameters and what has no group of its own."""
        self.services = {}
        self.timers = []
        self.logged = []
        self.descriptions = {}
        self.values = {}
        self.may_change = []
        self.messages = Messages()
        self.sent = defaultdict(list)
        self.subscriptions = defaultdict(list)
        self.retained = {}
        self.made.append(self)

    def change_state(self, transition):
        with self.group.lock:
            goal = TRANSITIONS.get((self.state, transition))
            if goal is None:
                raise RuntimeError(f"no transition {transition} in the state {self.state}")
            result = getattr(self, f"on_{transition}")(None)
            if result == ERROR:
                self.state = "unconfigured" if self.on_error(None) == SUCCESS else "finalized"
            elif result == SUCCESS or goal == "finalized":
                self.state = goal
            return result

    def trigger_configure(self):
        return self.change_state("configure")

    def trigger_activate(self):
        return self.change_state("activate")

    def trigger_deactivate(self):
        return self.change_state("deactivate")

    def call(self, service):
        """Call a service as another node does."""
        answer, group = self.services[service]
        with group.lock:
            return answer(None, types.SimpleNamespace(success=None, message=""))

    def set_parameter(self, name, value):
        """Set a parameter as another node does, and return the result."""
        with self.group.lock:
            change = types.SimpleNamespace(name=name, value=value)
            for check in self.may_change:
                result = check([change])
                if not result.successful:
                    return result
            self.values[name] = value
            return result

    def declare_parameter(self, name, value, descriptor=None):
        self.values[name] = self.given.get(name, value)
        self.descriptions[name] = descriptor
        return self.get_parameter(name)

    def get_parameter(self, name):
        return types.SimpleNamespace(value=self.values[name])

    def add_on_set_parameters_callback(self, check):
        self.may_change.append(check)

    def get_namespace(self):
        return self.namespace

    def get_name(self):
        return self.name

    def get_fully_qualified_name(self):
        return f"{self.namespace}/{self.name}"

    def get_logger(self):
        return types.SimpleNamespace(error=self.logged.append, warning=self.logged.append)

    def resolve_topic_name(self, name):
        return f"{self.namespace}/{name}"

    def create_service(self, service, name, answer, callback_group=None):
        self.services[name] = (answer, callback_group or self.group)

    def create_timer(self, period_s, check, callback_group=None, clock=None):
        # A timer on ROS time stands still if simulated time does.
        assert clock == "steady"
        self.timers.append((check, callback_group or self.group))

    def create_publisher(self, kind, topic, quality):
        messages = self.sent[topic]

        def publish(data):
            messages.append(self.messages.decode(data, kind))

        return types.SimpleNamespace(publish=publish, get_subscription_count=lambda: 1)

    def create_subscription(self, kind, topic, callback, quality, *, raw, callback_group):
        assert raw
        subscription = (callback, callback_group or self.group)
        self.subscriptions[topic].append(subscription)
        if topic in self.retained and quality.get("durability") == "transient local":
            callback(self.retained[topic])
        return topic, subscription

    def destroy_publisher(self, publisher):
        del publisher.publish

    def destroy_subscription(self, subscription):
        topic, each = subscription
        self.subscriptions[topic].remove(each)

    def get_publishers_info_by_topic(self, topic):
        return []

    def destroy_node(self):
        self.state = "destroyed"

    def put(self, topic, message, latched=False):
        """Publish a message as another node does; a latched one also reaches later readers."""
        data = self.messages.encode(message)
        if latched:
            self.retained[topic] = data
        for callback, group in list(self.subscriptions[topic]):
            with group.lock:
                callback(data)

    def put_stop(self, is_stop, latched=False):
        message = self.messages.make("std_msgs/msg/Bool", is_stop)
        self.put(f"{self.namespace}/stop", message, latched)


class Executor:
    """Runs the timers of its nodes, one thread per group; an error in one of them ends `spin`."""

    made = ()

    def __init__(self, num_threads=1):
        self.num_threads = num_threads
        self.nodes = []
        self.ended = threading.Event()
        self.error = None
        self.made.append(self)

    def add_node(self, node):
        self.nodes.append(node)

    def spin(self):
        timers = defaultdict(list)
        for node in self.nodes:
            for check, group in node.timers:
                timers[group].append(check)
        threads = [
            threading.Thread(target=self._run_timers, args=(group, checks))
            for group, checks in timers.items()
        ]
        for thread in threads:
            thread.start()
        self.ended.wait()
        for thread in threads:
            thread.join()
        if self.error is not None:
            raise self.error

    def _run_timers(self, group, checks):
        while not self.ended.wait(0.005):
            for check in checks:
                try:
                    with group.lock:
                        check()
                except Exception as error:
                    self.fail(error)

    def fail(self, error):
        self.error = error
        self.ended.set()

    def shutdown(self, timeout_sec):
        self.ended.set()


def create_node(name):
    return LifecycleNode(name)


def install_rclpy(patches):
    """Install the modules, and return the nodes and the executors that they make."""
    patches.setattr(LifecycleNode, "made", [])
    patches.setattr(Executor, "made", [])
    returned = types.SimpleNamespace(SUCCESS=SUCCESS, FAILURE=FAILURE, ERROR=ERROR)
    trigger = types.SimpleNamespace(Request=None, Response=None)
    options = types.SimpleNamespace(NO="no handlers")
    reliability = types.SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort")
    module(
        patches,
        "rclpy",
        init=lambda args, signal_handler_options: None,
        create_node=create_node,
        try_shutdown=lambda: None,
    )
    module(
        patches,
        "rclpy.clock",
        Clock=lambda clock_type: clock_type,
        ClockType=types.SimpleNamespace(STEADY_TIME="steady"),
    )
    module(patches, "rclpy.callback_groups", MutuallyExclusiveCallbackGroup=Group)
    module(
        patches,
        "rclpy.executors",
        Executor=Executor,
        MultiThreadedExecutor=Executor,
        SingleThreadedExecutor=Executor,
    )
    module(
        patches,
        "rclpy.lifecycle",
        LifecycleNode=LifecycleNode,
        TransitionCallbackReturn=returned,
    )
    module(patches, "rclpy.node", Node=LifecycleNode)
    module(patches, "rclpy.parameter", Parameter=None)
    module(
        patches,
        "rclpy.qos",
        QoSProfile=lambda **policies: policies,
        ReliabilityPolicy=reliability,
        DurabilityPolicy=types.SimpleNamespace(TRANSIENT_LOCAL="transient local"),
    )
    module(patches, "rclpy.signals", SignalHandlerOptions=options)
    module(
        patches,
        "rcl_interfaces.msg",
        ParameterDescriptor=lambda description: description,
        SetParametersResult=types.SimpleNamespace,
    )
    module(patches, "std_srvs.srv", Trigger=trigger)
    for package, names in {
        "diagnostic_msgs": ("DiagnosticArray",),
        "geometry_msgs": ("WrenchStamped",),
        "sensor_msgs": ("JointState",),
        "std_msgs": ("Bool", "Float64", "String"),
        "tf2_msgs": ("TFMessage",),
    }.items():
        # A class is the name of its type.
        kinds = {name: f"{package}/msg/{name}" for name in names}
        module(patches, f"{package}.msg", **kinds)
    return types.SimpleNamespace(nodes=LifecycleNode.made, executors=Executor.made)


@contextlib.contextmanager
def imported_nodes():
    """The modules of the package that import rclpy; made anew, because they hold the stand-ins."""
    names = ("parameters", "fin", "robot")
    loaded = {name: importlib.import_module(f"softfin_ros.{name}") for name in names}
    try:
        yield types.SimpleNamespace(**loaded)
    finally:
        for name in names:
            del sys.modules[f"softfin_ros.{name}"]
