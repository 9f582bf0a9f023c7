from types import SimpleNamespace

import numpy as np
import pytest

from softfin.control.feedback import UNFAMILIAR, Estimate
from softfin.rig.machine import Sample, Target
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.diagnostics import (
    ERROR,
    OK,
    WARNING,
    FinDiagnostics,
    Status,
    encode_diagnostics,
)
from softfin.rig.ros2.node import RosNode
from softfin.rig.stop import StopRequest
from tests.rig.ros2_memory import MemoryTransport, Messages


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def sample(clock, age_s=0.02, complaints=(), current=0.5):
    wrench = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    return Sample(clock.now, 0.5, 1.5, current, None, clock.now - age_s, wrench, complaints)


def second(clock, diagnostics, period_s=0.01, **values):
    for _ in range(round(1 / period_s)):
        clock.now += period_s
        diagnostics.add(sample(clock, **values))
    return {status.name: status for status in diagnostics.take()}


def test_a_loop_on_time_with_new_readings_is_ok(clock):
    diagnostics = FinDiagnostics(clock)
    diagnostics.state = "active"
    statuses = second(clock, diagnostics)
    assert [status.level for status in statuses.values()] == [OK] * 4
    assert statuses["fin"].message == "active"
    assert statuses["fin"].values == {"state": "active"}
    assert statuses["loop"].values == {"ticks": 99, "longest_tick_ms": 10.0}
    assert statuses["sensor"].values == {"force_age_ms": 20.0, "joint_age_ms": 0.0}
    assert statuses["estimator"].message == "off"


def test_each_second_counts_by_itself(clock):
    diagnostics = FinDiagnostics(clock)
    assert second(clock, diagnostics, period_s=0.05)["loop"].level == WARNING
    statuses = second(clock, diagnostics)
    assert statuses["loop"].level == OK
    assert statuses["loop"].values["ticks"] == 100


def test_a_gap_between_two_seconds_is_late(clock):
    diagnostics = FinDiagnostics(clock)
    second(clock, diagnostics)
    clock.now += 0.1
    assert second(clock, diagnostics)["loop"].level == WARNING
    diagnostics.take()
    clock.now += 100.0
    assert second(clock, diagnostics)["loop"].level == OK, "inactive in between"


@pytest.mark.parametrize(("age_s", "level"), [(0.09, OK), (0.12, WARNING)])
def test_an_old_force_is_a_warning(clock, age_s, level):
    assert second(clock, FinDiagnostics(clock), age_s=age_s)["sensor"].level == level


def test_a_complaint_of_a_device_is_an_error(clock):
    status = second(clock, FinDiagnostics(clock), complaints=("sensor: cable; plug it in",))
    assert status["sensor"][1:3] == (ERROR, "sensor: cable; plug it in")


@pytest.mark.parametrize(("level", "expected"), [(1.0, OK), (UNFAMILIAR + 1, WARNING)])
def test_the_estimate_of_the_feedback_is_included(clock, level, expected):
    diagnostics = FinDiagnostics(clock)
    pair = np.array([0.12341, -1.0])
    diagnostics.estimate = Estimate(pair, pair * 0.1, pair * 0, np.float64(level))
    status = second(clock, diagnostics)["estimator"]
    assert status.level == expected
    assert status.values["force_n"] == [0.1234, -1.0]
    assert status.values["drift_n"] == [0.0, 0.0]
    assert status.values["level"] == level


def test_before_the_first_sample_only_the_state_is_known(clock):
    diagnostics = FinDiagnostics(clock)
    diagnostics.state = "stopped"
    diagnostics.reason = "the sensor is gone"
    assert diagnostics.take() == [Status("fin", ERROR, "the sensor is gone", {"state": "stopped"})]


def test_the_message_is_a_diagnostic_array():
    statuses = [Status("loop", WARNING, "late", {"rate_hz": 90.0}), Status("fin", OK, "active", {})]
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    message = Messages().decode(encode_diagnostics(3 * 10**9 + 7, "tail", statuses), kind)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 7)
    loop, fin = message.status
    assert (loop.level, loop.name, loop.message) == (WARNING, "tail: loop", "late")
    assert [(pair.key, pair.value) for pair in loop.values] == [("rate_hz", "90.0")]
    assert (fin.hardware_id, fin.values) == ("tail", [])


@pytest.fixture
def node(clock):
    transport = MemoryTransport(clock)
    config = NodeConfig.of_fin("ucat/tail")
    return SimpleNamespace(
        sent=transport.sent,
        latched=transport.latched,
        node=RosNode(transport, config, print, clock=clock, torque_constant_nm_a=2.0),
    )


def test_a_node_sends_diagnostics_once_per_second(clock, node):
    for _ in range(250):
        clock.now += 0.01
        node.node.observe(StopRequest(), sample(clock), None)
    assert len(node.sent["/diagnostics"]) == 1 + 2
    names = [status.name for status in node.sent["/diagnostics"][-1].status]
    assert names == [f"ucat/tail: {name}" for name in ("fin", "loop", "sensor", "estimator")]


def test_the_state_changes_with_the_first_command_and_the_reason_is_kept(clock, node):
    node.node.observe(StopRequest(), sample(clock), None)
    node.node.observe(StopRequest(), sample(clock), Target(0.0, 1.0))
    node.node.announce("stopped", "a wave")
    messages = [message.status[0].message for message in node.sent["/diagnostics"]]
    assert messages == ["inactive", "active", "a wave"]
    topic = "/ucat/tail/stop_reason"
    assert [message.data for message in node.sent[topic]] == ["", "", "a wave"]
    assert [name for name, latched in node.latched.items() if latched] == [topic]


@pytest.mark.parametrize(("current", "effort"), [(0.5, [1.0]), (None, [])])
def test_the_effort_is_the_torque_of_the_motor_if_the_current_is_known(
    clock, node, current, effort
):
    node.node.observe(StopRequest(), sample(clock, current=current), None)
    assert node.sent["/ucat/tail/joint_states"][0].effort.tolist() == effort
    currents = [message.data for message in node.sent["/ucat/tail/current"]]
    assert currents == ([] if current is None else [current])
