from types import SimpleNamespace

import numpy as np
import pytest

from softfin.control.feedback import UNFAMILIAR, Estimate
from softfin.rig.machine import Sample
from softfin_ros.diagnostics import (
    DIAGNOSTICS,
    ERROR,
    OK,
    WARNING,
    FinDiagnostics,
    Status,
    encode_diagnostics,
)
from softfin_ros.status import FinStatus
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
    data = encode_diagnostics(3 * 10**9 + 7, "tail", statuses)
    message = Messages().decode(data, DIAGNOSTICS)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 7)
    loop, fin = message.status
    assert (loop.level, loop.name, loop.message) == (WARNING, "tail: loop", "late")
    assert [(pair.key, pair.value) for pair in loop.values] == [("rate_hz", "90.0")]
    assert (fin.hardware_id, fin.values) == ("tail", [])


def test_texts_that_utf_8_cannot_represent_are_replaced():
    statuses = [Status("fin", OK, "caf\xe9 \udcff", {"key \udcff": "value \udcff"})]
    message = Messages().decode(encode_diagnostics(0, "tail\udcff", statuses), DIAGNOSTICS)
    (status,) = message.status
    assert (status.name, status.message) == ("tail?: fin", "caf\xe9 ?")
    assert [(pair.key, pair.value) for pair in status.values] == [("key ?", "value ?")]


@pytest.fixture
def there(clock):
    transport = MemoryTransport(clock)
    reported = []
    status = FinStatus(transport, "/tail/stop_reason", "tail", reported.append, clock)
    return SimpleNamespace(status=status, transport=transport, reported=reported)


def test_the_diagnostics_are_sent_once_per_second_and_after_each_change(clock, there):
    def count():
        return len(there.transport.sent["/diagnostics"])

    there.status.update("inactive", "")
    for _ in range(250):
        clock.now += 0.01
        there.status.add(sample(clock))
        there.status.update("inactive", "")
    assert count() == 1 + 2
    there.status.update("active", "")
    there.status.update("active", "a wave")
    assert count() == 1 + 2 + 2
    names = [status.name for status in there.transport.sent["/diagnostics"][2].status]
    assert names == [f"tail: {name}" for name in ("fin", "loop", "sensor", "estimator")]


def test_the_reason_of_the_stop_is_latched_and_sent_when_it_changes(there):
    for reason in ("", "a wave", "a wave", ""):
        there.status.update("stopped" if reason else "inactive", reason)
    sent = [message.data for message in there.transport.sent["/tail/stop_reason"]]
    assert sent == ["", "a wave", ""]
    assert there.transport.latched == {"/tail/stop_reason": True, "/diagnostics": False}


def test_what_cannot_be_sent_is_reported_once(there):
    there.transport.failing = True
    there.status.update("inactive", "")
    there.status.update("active", "")
    assert there.reported == ["/diagnostics: not sent"]
