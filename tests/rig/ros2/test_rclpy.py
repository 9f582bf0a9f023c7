"""rclpy is not to be had here: a stand-in checks how it is called, after its documentation."""

import sys
import threading
import time
import types

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.rig.ros2.config import NodeConfig, TransportConfig
from softfin.rig.ros2.connection import BOOL, Transport
from softfin.rig.ros2.inputs import EmergencyStop, OnceReporter
from softfin.rig.ros2.node import RosNode
from softfin.rig.ros2.plant import open_transport
from softfin.rig.ros2.rclpy import NodeTransport
from tests.patience import HANG_S, wait_until
from tests.rig.ros2_memory import JOINT, WRENCH


class Rclpy:
    """What softfin uses of it, and what was asked of it."""

    def __init__(self, monkeypatch):
        self.calls = []
        self.subscriptions = {}
        self.published = []
        self.spinning = threading.Event()
        self.ended = threading.Event()
        self.fails = None
        self.commanders = [("/", "teleop"), ("/", "tail")]
        names = {
            "rclpy": self._top(),
            "rclpy.executors": types.SimpleNamespace(SingleThreadedExecutor=self.executor),
            "rclpy.signals": types.SimpleNamespace(
                SignalHandlerOptions=types.SimpleNamespace(NO="no handlers")
            ),
            "rclpy.qos": types.SimpleNamespace(
                QoSProfile=lambda **policies: policies,
                ReliabilityPolicy=types.SimpleNamespace(
                    RELIABLE="reliable", BEST_EFFORT="best effort"
                ),
                DurabilityPolicy=types.SimpleNamespace(TRANSIENT_LOCAL="transient local"),
                LivelinessPolicy=types.SimpleNamespace(MANUAL_BY_TOPIC="manual by topic"),
            ),
            "rclpy.duration": types.SimpleNamespace(Duration=lambda seconds: f"{seconds} s"),
            "sensor_msgs.msg": types.SimpleNamespace(JointState="JointState"),
            "geometry_msgs.msg": types.SimpleNamespace(WrenchStamped="WrenchStamped"),
            "std_msgs.msg": types.SimpleNamespace(Bool="Bool", Float64="Float64", String="String"),
            "diagnostic_msgs.msg": types.SimpleNamespace(DiagnosticArray="DiagnosticArray"),
        }
        for name, fields in names.items():
            module = types.ModuleType(name)
            module.__dict__.update(fields.__dict__)
            module.__spec__ = types.SimpleNamespace(name=name)
            monkeypatch.setitem(sys.modules, name, module)

    def _top(self):
        return types.SimpleNamespace(
            Context=lambda: "context",
            init=self.init,
            create_node=self.create_node,
            try_shutdown=lambda context: self.calls.append(("try_shutdown", context)),
        )

    def init(self, *, args, context, domain_id, signal_handler_options):
        self.calls.append(("init", args, context, domain_id, signal_handler_options))
        if self.fails:
            raise RuntimeError(self.fails)

    def create_node(self, name, *, context):
        self.calls.append(("create_node", name, context))
        self.name = name
        return self

    def executor(self, *, context):
        self.calls.append(("executor", context))
        return types.SimpleNamespace(
            add_node=lambda node: None, spin=self.spin, shutdown=self.shutdown
        )

    def spin(self):
        self.spinning.set()
        self.ended.wait(HANG_S)
        if self.fails:
            raise RuntimeError(self.fails)

    def shutdown(self, timeout_sec):
        self.calls.append(("shutdown", timeout_sec))
        self.ended.set()

    def destroy_node(self):
        self.calls.append(("destroy_node",))

    def create_publisher(self, kind, topic, quality):
        self.calls.append(("create_publisher", kind, topic, quality))

        def publish(data):
            if self.fails:
                raise RuntimeError(self.fails)
            assert isinstance(data, bytes)
            self.published.append((topic, data))

        return types.SimpleNamespace(publish=publish, get_subscription_count=lambda: 3)

    def get_fully_qualified_name(self):
        return f"/{self.name}"

    def create_subscription(self, kind, topic, callback, quality, *, raw, callback_group):
        assert raw
        assert callback_group is None
        self.calls.append(("create_subscription", kind, topic, quality))
        self.subscriptions[topic] = callback

    def destroy_publisher(self, publisher):
        self.calls.append(("destroy_publisher",))

    def destroy_subscription(self, subscription):
        self.calls.append(("destroy_subscription",))

    def get_publishers_info_by_topic(self, topic):
        names = {
            "/fin/wrench": [("/", "driver"), ("/lab", "driver")],
            "/command": self.commanders,
        }.get(topic, [])
        return [
            types.SimpleNamespace(node_namespace=namespace, node_name=name)
            for namespace, name in names
        ]

    def get_topic_names_and_types(self):
        return [("/ours", [JOINT]), ("/both", [JOINT]), ("/heard", [JOINT])]

    def count_publishers(self, topic):
        return {"/ours": 1, "/both": 2, "/heard": 0}[topic]


@pytest.fixture
def rclpy(monkeypatch):
    return Rclpy(monkeypatch)


@pytest.fixture
def transport(rclpy):
    opened = open_transport(TransportConfig(domain=5, node="tail"))
    assert rclpy.spinning.wait(HANG_S)
    yield opened
    opened.close()


def test_it_is_taken_where_it_is_and_leaves_signals_and_the_command_line_alone(rclpy, transport):
    assert isinstance(transport, Transport)
    assert rclpy.calls[0] == ("init", [], "context", 5, "no handlers")
    assert rclpy.calls[1] == ("create_node", "tail", "context")
    assert "ROS_LOCALHOST_ONLY" in transport.notes[0]


def test_messages_go_out_and_come_in_as_bytes(rclpy, transport):
    publisher = transport.publish("/ours", JOINT)
    publisher.send(b"one")
    assert rclpy.published == [("/ours", b"one")]
    assert publisher.readers() == 3
    take = transport.subscribe("/stop", BOOL, "best_effort").take
    assert (
        "create_publisher",
        "JointState",
        "/ours",
        {"depth": 10, "reliability": "reliable"},
    ) in rclpy.calls
    assert (
        "create_subscription",
        "Bool",
        "/stop",
        {"depth": 10, "reliability": "best effort"},
    ) in rclpy.calls
    before = time.monotonic()
    for index in range(12):
        rclpy.subscriptions["/stop"](bytes([index]))
    taken = take()
    assert [data[0] for data, _ in taken] == list(range(2, 12)), "ten are kept, the newest"
    assert before <= taken[0][1] <= taken[-1][1] <= time.monotonic()
    assert take() == []


def test_a_command_topic_offers_its_deadline_and_that_only_messages_keep_it_alive(rclpy, transport):
    transport.publish("/command", JOINT, deadline_s=0.2)
    offered = {
        "depth": 10,
        "reliability": "reliable",
        "deadline": "0.2 s",
        "liveliness": "manual by topic",
        "liveliness_lease_duration": "0.2 s",
    }
    assert ("create_publisher", "JointState", "/command", offered) in rclpy.calls


def test_a_latched_topic_keeps_its_last_message_for_later_readers(rclpy, transport):
    transport.publish("/ours", JOINT, latched=True)
    offered = {"depth": 1, "reliability": "reliable", "durability": "transient local"}
    assert ("create_publisher", "JointState", "/ours", offered) in rclpy.calls


def test_a_transport_over_a_node_of_others_destroys_only_what_it_made(rclpy):
    rclpy.name = "tail"
    transport = NodeTransport(rclpy)
    for _ in range(2):
        transport.publish("/command", JOINT)
        transport.subscribe("/stop", BOOL)
        assert transport.publishers("/command") == ["/teleop"]
        rclpy.calls.clear()
        transport.close()
        assert sorted(rclpy.calls) == [("destroy_publisher",), ("destroy_subscription",)]


def test_an_emergency_stop_has_a_reader_for_every_kind_of_publisher(rclpy, transport):
    EmergencyStop(transport, "/stop", OnceReporter(print))
    readers = [call[3] for call in rclpy.calls if call[0] == "create_subscription"]
    assert readers == [
        {"depth": 10, "reliability": "reliable"},
        {"depth": 10, "reliability": "best effort"},
        {"depth": 10, "reliability": "reliable", "durability": "transient local"},
    ]


def test_the_topics_are_those_that_somebody_else_publishes(transport):
    transport.publish("/ours", JOINT)
    transport.publish("/both", JOINT)
    assert transport.topics() == {"/both": JOINT}


def test_a_subscriber_keeps_as_many_messages_as_asked_for_and_names_its_publishers(
    rclpy, transport
):
    subscriber = transport.subscribe("/fin/wrench", WRENCH, "best_effort", depth=3)
    assert rclpy.calls[-1][3] == {"depth": 3, "reliability": "best effort"}
    for index in range(5):
        rclpy.subscriptions["/fin/wrench"](bytes([index]))
    assert [data for data, _ in subscriber.take()] == [b"\x02", b"\x03", b"\x04"]
    assert subscriber.publishers() == ["/driver", "/lab/driver"]
    assert transport.subscribe("/silent", WRENCH).publishers() == []


def test_other_nodes_may_have_the_same_name_as_ours(rclpy, transport):
    transport.publish("/command", JOINT)
    assert transport.publishers("/command") == ["/teleop"]
    rclpy.commanders += [("/", "tail")]
    assert transport.publishers("/command") == ["/tail", "/teleop"]
    assert transport.publishers("/silent") == []


def test_it_closes_once_and_its_thread_ends(rclpy, transport):
    transport.close()
    transport.close()
    assert [call[0] for call in rclpy.calls[-3:]] == ["shutdown", "destroy_node", "try_shutdown"]
    for thread in threading.enumerate():
        if thread.name == "softfin-rclpy":
            thread.join(HANG_S)
            assert not thread.is_alive()


def test_a_thread_that_failed_is_told_to_who_reads(rclpy, transport):
    node = RosNode(transport, NodeConfig(), print)
    rclpy.fails = "context is not\nvalid"
    rclpy.ended.set()
    wait_until(lambda: transport.failure is not None)
    assert node.stop_reason() == (
        "emergency stop cannot be received: rclpy has stopped (context is not valid); start softfin again"
    )
    with pytest.raises(DeviceError, match=r"/x: message not sent \(context is not valid\)"):
        transport.publish("/x", JOINT).send(b"")


def test_an_installation_that_does_not_start_is_told_in_one_line(rclpy):
    rclpy.fails = "failed to load\nlibrmw"
    with pytest.raises(
        RigError, match=r"rclpy cannot be used \(failed to load librmw\); use transport: dds"
    ):
        open_transport(TransportConfig())


def test_a_message_package_that_is_not_there_is_told(transport):
    with pytest.raises(
        RigError,
        match="this ROS 2 installation does not have own/msg/Flipper; build and source its package",
    ):
        transport.publish("/x", "own/msg/Flipper")
    with pytest.raises(RigError, match="this ROS 2 installation does not have std_msgs/msg/Empty"):
        transport.subscribe("/x", "std_msgs/msg/Empty")


def test_a_network_is_not_its_to_choose(rclpy):
    with pytest.raises(RigError, match="--network eth0 applies only to DDS"):
        open_transport(TransportConfig(network="eth0"))
