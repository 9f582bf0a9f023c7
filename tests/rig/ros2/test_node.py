import functools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from softfin.core.errors import ConfigurationError, CoverageError, RigError
from softfin.gaits.reachable import Cell, Reachable
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.inputs import EmergencyStop, OnceReporter
from softfin.rig.ros2.node import RosNode, default_reference_limit
from softfin.rig.stop import StopRequest
from tests.rig.ros2_memory import MemoryTransport

SAMPLE = Sample(10.0, 0.5, 1.5, None, None, 9.98, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), ())


class Node:
    def __init__(self, **changes):
        self.now = 10.0
        self.transport = MemoryTransport(lambda: self.now)
        self.told = []
        self.node = RosNode(
            self.transport, NodeConfig.build(changes), self.told.append, clock=lambda: self.now
        )

    def ask(self, x, y, frame="", topic="/fin/reference"):
        self.transport.put(
            topic, self.transport.messages.wrench(7, frame, (x, y, 0.0, 0.0, 0.0, 0.0))
        )

    def stop(self, asked=True, offered="reliable"):
        messages = self.transport.messages
        self.transport.put("/fin/stop", messages.make("std_msgs/msg/Bool", asked), offered=offered)


def test_every_sample_goes_out_and_a_command_where_it_is_new():
    node = Node(joint_name="tail", frame="mount")
    for target in (None, Target(1.0, 2.0), Target(1.0, 2.0), Target(0.0, 2.0)):
        node.node.publish(SAMPLE, target)
    sent = node.transport.sent
    assert [len(sent[f"/fin/{name}"]) for name in ("joint_states", "wrench", "command")] == [
        4,
        4,
        2,
    ]
    joint = sent["/fin/joint_states"][0]
    wrench = sent["/fin/wrench"][0]
    command = sent["/fin/command"][0]
    assert (joint.name, joint.position[0], joint.velocity[0]) == (["tail"], 0.5, 1.5)
    assert (wrench.wrench.force.x, wrench.wrench.torque.z, wrench.header.frame_id) == (
        1.0,
        6.0,
        "mount",
    )
    assert (command.position[0], command.velocity[0]) == (1.0, 2.0)
    stamps = [
        message.header.stamp.sec + message.header.stamp.nanosec / 1e9 for message in (joint, wrench)
    ]
    assert stamps[0] - stamps[1] == pytest.approx(0.02, abs=1e-3)


def test_the_newest_reference_counts_and_an_old_one_does_not():
    node = Node(reference_timeout_s=0.5)
    assert node.node.reference() is None
    node.ask(1.0, -1.0)
    node.ask(2.0, -0.5, "fin_mount")
    assert node.node.reference() == (2.0, -0.5)
    node.now = 10.4
    assert node.node.reference() == (2.0, -0.5)
    assert node.told == []
    node.now = 10.6
    assert node.node.reference() is None
    assert node.node.reference() is None
    assert node.told == ["/fin/reference: no reference for 0.5 s, so the last one has expired"]
    node.ask(3.0, 0.0)
    assert node.node.reference() == (3.0, 0.0)


@pytest.mark.parametrize("lost", ["keep", "zero", "stop"])
def test_references_that_end_are_followed_by_what_is_configured(lost):
    node = Node(reference_timeout_s=0.5, reference_lost=lost)
    request = StopRequest()
    node.node.observe(request, SAMPLE, None)
    node.now += 100.0
    node.node.observe(request, SAMPLE, None)
    assert node.node.reference() is None, "none has come yet"
    node.ask(2.0, -0.5)
    for _ in range(5):
        node.node.observe(request, SAMPLE, None)
        assert node.node.reference() == (2.0, -0.5)
        node.now += 0.1
    node.now += 0.1
    node.node.observe(request, SAMPLE, None)
    assert node.node.reference() == ((0.0, 0.0) if lost == "zero" else None)
    reason = "/fin/reference: no reference for 0.5 s; start its publisher, then restart this node"
    assert request.trip == (("reference_lost", reason) if lost == "stop" else None)
    node.ask(1.0, 1.0)
    assert node.node.reference() == (1.0, 1.0)


def test_references_that_are_all_refused_are_lost_too():
    node = Node(reference_timeout_s=0.5, reference_lost="stop")
    request = StopRequest()
    node.ask(1.0, 1.0)
    for _ in range(10):
        node.node.observe(request, SAMPLE, None)
        node.ask(math.nan, 1.0)
        node.now += 0.1
    assert request.trip is not None


def test_no_force_that_the_controller_cannot_make_is_refused_at_once():
    def resolve(force):
        raise CoverageError(f"reference {force}: not trained for")

    with pytest.raises(CoverageError):
        RosNode(MemoryTransport(), NodeConfig(reference_lost="zero"), print, resolve)
    RosNode(MemoryTransport(), NodeConfig(), print, resolve)


def test_a_loss_without_an_age_is_refused():
    with pytest.raises(
        ConfigurationError, match="reference_lost = stop: needs a timeout; set reference_timeout_s"
    ):
        NodeConfig.build({"reference_lost": "stop", "reference_timeout_s": None})


def test_one_fin_of_a_robot_has_topics_under_its_name_and_stops_without_its_robot():
    config = NodeConfig.of_fin("ucat/front_left")
    assert {value for name, value in config if name.endswith("_topic")} == {
        f"/ucat/front_left/{name}"
        for name in (
            "joint_states",
            "wrench",
            "command",
            "reference",
            "stop",
            "current",
        )
    }
    assert config.connection.node == "ucat_front_left"
    assert config.reference_lost == "stop"


@pytest.mark.parametrize(
    "name", ["left fin", "/left", "left/", "1", "", "a//b", "schw\u00e4nzchen"]
)
def test_a_fin_whose_name_cannot_be_in_a_topic_is_refused(name):
    with pytest.raises(ConfigurationError, match="cannot be part of a topic name; use letters"):
        NodeConfig.of_fin(name)


def test_without_a_timeout_the_newest_is_obeyed_for_ever():
    node = Node(reference_timeout_s=None)
    node.ask(1.0, 2.0)
    node.now = 1e6
    assert node.node.reference() == (1.0, 2.0)


@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf, 21.0, -1e300])
def test_a_reference_that_cannot_be_is_refused_counted_and_told_once(x):
    node = Node()
    node.ask(1.0, 1.0)
    node.node.reference()
    for _ in range(3):
        node.ask(x, 0.0)
        assert node.node.reference() == (1.0, 1.0)
    assert node.node.counters()["references_refused"] == 3
    assert len(node.told) == 1


def circle(reach_n):
    return Reachable(np.zeros(2, np.float32), np.full(32, reach_n, np.float32))


@pytest.mark.parametrize(
    ("reachable", "cells", "limit_n"),
    [
        (None, (), 20.0),
        (circle(2.4), (Cell.around((2, 0), 3.0),), 20.0),
        (circle(0.15), (Cell.around((0.1, 0), 0.1),), 1.0),
        (circle(31.0), (Cell.around((0, 0), 60.0),), 200.0),
        (None, (Cell.around((0, 0), 2.0), Cell(low=(0, -45), high=(30, 0))), 45.0),
    ],
)
def test_the_default_limit_follows_the_size_of_the_fin_and_covers_the_cells(
    reachable, cells, limit_n
):
    controller = SimpleNamespace(reachable=reachable, cells=cells)
    assert default_reference_limit(controller) == limit_n


def test_a_limit_of_the_user_comes_before_the_default():
    transport = MemoryTransport(lambda: 10.0)
    told = []
    config = NodeConfig(reference_limit_n=2.0)
    node = RosNode(transport, config, told.append, default_limit_n=200.0)
    transport.put(
        "/fin/reference", transport.messages.wrench(7, "", (3.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    )
    assert node.reference() is None
    assert "exceeds reference_limit_n = 2 N" in told[0]


def test_a_reference_in_another_frame_or_of_other_bytes_is_refused():
    node = Node()
    node.ask(1.0, 1.0, "camera")
    assert node.node.reference() is None
    node.transport.put("/fin/reference", b"\x00\x01\x00\x00")
    assert node.node.reference() is None
    told = node.told
    assert len(told) == 2
    assert "frame is 'camera', expected 'fin_mount'" in told[0]
    assert all("\n" not in line for line in told)


def test_a_stop_is_for_good():
    node = Node()
    assert node.node.stop_reason() is None
    node.stop(False)
    assert node.node.stop_reason() is None
    node.stop()
    node.stop(False)
    assert node.node.stop_reason() == "emergency stop on /fin/stop"
    node.stop(False)
    assert node.node.stop_reason() == "emergency stop on /fin/stop"


def test_a_stop_that_cannot_be_read_stops_too():
    node = Node()
    node.transport.put("/fin/stop", b"\x00\x01\x00\x00")
    assert "not a valid std_msgs/msg/Bool" in node.node.stop_reason()
    node = Node()
    node.transport.failing = True
    assert "cannot be received" in node.node.stop_reason()


def test_a_stop_that_cannot_be_read_is_not_taken_back_by_the_next_message():
    node = Node()
    node.transport.put("/fin/stop", b"\x00\x01\x00\x00")
    node.stop(asked=False)
    assert "unreadable message" in node.node.stop_reason()
    assert "unreadable message" in node.node.stop_reason()


@pytest.mark.parametrize("offered", ["reliable", "best_effort", "latched", "from before"])
def test_a_stop_is_heard_from_every_kind_of_publisher(offered):
    node = Node()
    node.stop(False, offered)
    assert node.node.stop_reason() is None
    node.stop(True, offered)
    assert node.node.stop_reason() == "emergency stop on /fin/stop"


def test_a_stop_that_cannot_be_read_counts_once_however_many_readers_it_comes_to():
    node = Node()
    node.transport.put("/fin/stop", b"\x00\x01\x00\x00", offered="latched")
    node.node.stop_reason()
    assert node.node.counters()["stops_refused"] == 1


@pytest.mark.parametrize(
    ("topic", "told"),
    [
        (
            "/fin/stop",
            "/fin/stop: messages from a publisher cannot be received, so it cannot stop the fin; use the",
        ),
        (
            "/fin/reference",
            "/fin/reference: messages from a publisher cannot be received; its quality of service must be reliable",
        ),
    ],
)
def test_a_publisher_that_is_not_heard_is_told_once(topic, told):
    node = Node()
    node.node.observe(StopRequest(), SAMPLE, None)
    assert node.told == []
    node.transport.mismatched[topic] = 1
    node.node.observe(StopRequest(), SAMPLE, None)
    node.node.observe(StopRequest(), SAMPLE, None)
    assert len(node.told) == 1
    assert node.told[0].startswith(told)


def test_a_session_hears_of_the_stop_through_its_observer():
    node = Node()
    request = StopRequest()
    observe = functools.partial(node.node.observe, request)
    observe(SAMPLE, None)
    assert request.trip is None
    node.stop()
    observe(SAMPLE, None)
    assert request.trip == ("emergency_stop", "emergency stop on /fin/stop")
    assert len(node.transport.sent["/fin/joint_states"]) == 2


def test_what_cannot_go_out_is_counted_and_does_not_stop_the_loop():
    node = Node()
    node.transport.failing = True
    node.node.publish(SAMPLE, None)
    node.node.publish(SAMPLE, None)
    assert node.node.counters()["unsent"] == 2
    assert node.told == ["/fin/joint_states: not sent"]
    assert node.node.reference() is None


def test_two_topics_of_one_name_are_refused():
    with pytest.raises(ConfigurationError, match="/fin/wrench is used for two topics"):
        NodeConfig.build({"reference_topic": "/fin/wrench"})


def test_twenty_different_remarks_are_reported_once_each_and_no_more():
    reported = []
    once = OnceReporter(reported.append)
    for _ in range(2):
        for number in range(30):
            once(f"remark {number}")
    assert reported == [f"remark {number}" for number in range(20)]


@pytest.mark.parametrize(
    ("current", "constant", "effort"), [(0.5, 2.0, [1.0]), (0.5, None, []), (None, 2.0, [])]
)
def test_the_effort_is_the_torque_of_the_motor_if_it_is_known(current, constant, effort):
    transport = MemoryTransport()
    node = RosNode(transport, NodeConfig(), print, torque_constant_nm_a=constant)
    node.publish(SAMPLE._replace(current=current), Target(0.0, 1.0))
    assert transport.sent["/fin/joint_states"][0].effort.tolist() == effort
    currents = [message.data for message in transport.sent["/fin/current"]]
    assert currents == ([] if current is None else [current])
    # The command is more urgent than what is only measured.
    assert transport.order[2:] == ["/fin/command", *["/fin/current"] * len(currents)]


@pytest.mark.parametrize(
    ("frame", "is_accepted"),
    [
        ("tail/fin_mount", True),
        ("", True),
        ("fin_mount", True),
        ("front/fin_mount", False),
        ("tail", False),
    ],
)
def test_the_frame_of_a_fin_of_a_robot_may_be_named_without_the_fin(frame, is_accepted):
    transport = MemoryTransport()
    node = RosNode(transport, NodeConfig.of_fin("tail"), print, clock=lambda: 0.0)
    wrench = transport.messages.wrench(7, frame, (1.0, 2.0, 0.0, 0.0, 0.0, 0.0))
    transport.put("/tail/reference", wrench)
    assert node.reference() == ((1.0, 2.0) if is_accepted else None)
    node.publish(SAMPLE, None)
    assert transport.sent["/tail/wrench"][0].header.frame_id == "tail/fin_mount"


class Stop:
    """The stop on a topic."""

    def __init__(self):
        self.transport = MemoryTransport()
        self.memory = EmergencyStop(self.transport, "/fin/stop", OnceReporter(print))

    def put(self, asked, offered="reliable"):
        message = self.transport.messages.make("std_msgs/msg/Bool", asked)
        self.transport.put("/fin/stop", message, offered=offered)


def test_a_stop_is_reset_when_its_topic_no_longer_requests_it():
    stop = Stop()
    stop.put(True)
    assert stop.memory.reason() == "emergency stop on /fin/stop"
    with pytest.raises(RigError, match="/fin/stop: still requests a stop; publish false"):
        stop.memory.reset()
    stop.put(False)
    stop.memory.reset()
    assert stop.memory.reason() is None
    stop.put(True)
    assert stop.memory.reason() == "emergency stop on /fin/stop"


def test_a_stop_that_arrives_with_a_refused_reset_is_remembered():
    stop = Stop()
    stop.put(True)
    with pytest.raises(RigError, match="still requests a stop"):
        stop.memory.reset()
    assert stop.memory.reason() == "emergency stop on /fin/stop"


@pytest.mark.parametrize("offered", ["reliable", "best_effort", "latched"])
def test_a_second_publisher_does_not_take_back_a_stop_that_readers_still_hold(offered):
    stop = Stop()
    stop.put(True, "from before")
    stop.put(False, "reliable")
    with pytest.raises(RigError, match="still requests a stop"):
        stop.memory.reset()
    stop.put(True, offered)
    stop.put(False, "latched")
    stop.memory.reset()
    assert stop.memory.reason() is None


@pytest.mark.parametrize("offered", ["reliable", "best_effort", "latched"])
def test_an_unreadable_stop_is_reset_only_after_a_readable_message(offered):
    stop = Stop()
    stop.transport.put("/fin/stop", b"\x00\x01\x00\x00", offered=offered)
    with pytest.raises(RigError, match="publish false"):
        stop.memory.reset()
    stop.put(False, offered)
    stop.memory.reset()
    assert stop.memory.reason() is None


def test_a_stop_that_cannot_be_received_is_not_reset():
    stop = Stop()
    stop.transport.failing = True
    with pytest.raises(RigError):
        stop.memory.reset()
    assert "cannot be received" in stop.memory.reason()


def test_reasons_of_several_stops_are_kept_once_each():
    stop = Stop()
    stop.memory.stop("by hand")
    stop.memory.stop("by hand")
    assert stop.memory.reason() == "by hand"
    stop.memory.stop("stopped: by hand; BUT the motor may be on")
    stop.memory.stop("by hand")
    assert stop.memory.reason() == "stopped: by hand; BUT the motor may be on"
    stop.memory.stop("a wave")
    assert stop.memory.reason() == "stopped: by hand; BUT the motor may be on; a wave"
    stop.memory.reset()
    assert stop.memory.reason() is None


def test_a_node_may_share_its_memory_of_a_stop():
    stop = Stop()
    node = RosNode(stop.transport, NodeConfig(), print, emergency_stop=stop.memory)
    stop.memory.stop("by hand")
    request = StopRequest()
    node.observe(request, SAMPLE, None)
    assert request.trip == ("emergency_stop", "by hand")
    assert len(stop.transport.asked["/fin/stop"]) == 3
