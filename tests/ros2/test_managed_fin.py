import threading
from types import SimpleNamespace

import pytest

from softfin.core.errors import ConfigurationError, DeviceError, RigError
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.ros2.config import fin_topics
from softfin.rig.safety import SafetyConfig
from softfin.rig.stop import Trip
from softfin.stages import driving
from softfin_ros.managed_fin import FinParameters
from tests.cli.test_ros2 import Controller, StillFin
from tests.patience import HANG_S, wait_until
from tests.rig.ros2_memory import MemoryTransport

# Recordings, and the waits of real time.
pytestmark = pytest.mark.slow


@pytest.fixture
def there(monkeypatch, tmp_path):
    machine = StillFin()
    controller = Controller()
    safety = SafetyConfig(stale_s=1.0, force_stale_s=1.0, overrun_s=1.0, watchdog_s=2.0)
    monkeypatch.setattr(driving, "load_controller", lambda folder: controller)
    setup = RobotSetup(machine, safety, settle_s=0.1)
    monkeypatch.setattr(driving, "find_robot", lambda name: setup)
    transport = MemoryTransport()
    parameters = FinParameters(controller="controller", folder=str(tmp_path), arm=True)
    return SimpleNamespace(
        machine=machine, controller=controller, transport=transport, parameters=parameters
    )


@pytest.fixture
def fin(there):
    fin = there.parameters.connect(there.transport, fin_topics("tail"), "tail")
    results = []
    thread = threading.Thread(target=lambda: results.append(fin.run()))
    thread.start()
    yield fin
    fin.shut_down()
    thread.join(HANG_S)
    assert results == [False]


def publish_stop(there, asked):
    there.transport.put("/tail/stop", there.transport.messages.make("std_msgs/msg/Bool", asked))


def reasons(there):
    return [message.data for message in there.transport.sent["/tail/stop_reason"]]


def test_an_inactive_fin_sends_neither_samples_nor_commands(there, fin, tmp_path):
    wait_until(lambda: len(there.transport.sent["/diagnostics"]) > 0)
    assert set(there.transport.sent) <= {"/tail/stop_reason", "/diagnostics"}
    assert there.machine.reads == 0
    assert list(tmp_path.iterdir()) == []


def test_an_active_fin_moves_until_it_is_deactivated_and_may_be_activated_again(
    there, fin, tmp_path
):
    for count in (1, 2):
        fin.activate()
        assert fin.state == "active"
        actions = len(there.controller.asked)
        wait_until(lambda actions=actions: len(there.controller.asked) > actions)
        fin.deactivate()
        assert fin.state == "inactive"
        assert fin.reason == ""
        assert there.machine.stops >= count
        reads = there.machine.reads
        diagnosed = len(there.transport.sent["/diagnostics"])
        wait_until(
            lambda diagnosed=diagnosed: len(there.transport.sent["/diagnostics"]) > diagnosed
        )
        assert there.machine.reads == reads, "no device is open"
    assert reasons(there)[-1] == ""
    assert all(path.name.startswith("tail-") for path in tmp_path.iterdir())


def test_a_stop_lasts_until_the_reset(there, fin):
    fin.activate()
    fin.stop("stopped by the service ~/stop")
    wait_until(lambda: fin.state == "stopped")
    reason = "stopped, motor disabled: stopped by the service ~/stop"
    assert fin.reason == reason
    assert reasons(there)[-1] == reason
    with pytest.raises(RigError, match="stopped by the service ~/stop; call the service ~/reset"):
        fin.activate()
    fin.reset()
    assert reasons(there)[-1] == ""
    fin.activate()
    with pytest.raises(RigError, match="the fin is active; deactivate it first"):
        fin.reset()


def test_an_inactive_fin_can_be_stopped_too(there, fin):
    fin.stop("by hand")
    with pytest.raises(RigError, match="by hand; call the service ~/reset first"):
        fin.activate()
    assert there.machine.reads == 0


def test_a_stop_of_the_topic_is_reset_only_when_the_topic_allows_it(there, fin):
    fin.activate()
    publish_stop(there, True)
    wait_until(lambda: fin.state == "stopped")
    with pytest.raises(RigError, match="/tail/stop: still requests a stop"):
        fin.reset()
    publish_stop(there, False)
    fin.reset()
    fin.activate()


def test_zeroing_rests_and_starts_the_controller_again(there, fin):
    with pytest.raises(RigError, match="the fin is inactive; activate it"):
        fin.zero()
    started = []
    init = there.controller.init
    object.__setattr__(there.controller, "init", lambda: started.append(1) or init())
    fin.activate()
    wait_until(lambda: there.controller.asked)
    fin.zero()
    assert len(started) == 2
    assert fin.state == "active"


def test_a_stop_ends_the_wait_for_the_zero(there, fin):
    fin.activate()
    publish_stop(there, True)
    with pytest.raises(RigError, match=r"emergency stop on /tail/stop|the fin is stopped"):
        fin.zero()


def test_a_device_that_cannot_be_opened_leaves_the_fin_inactive(there, fin):
    def fail():
        raise DeviceError("drive: no supply; switch it on")

    there.machine.open = fail
    with pytest.raises(RigError, match="drive: no supply"):
        fin.activate()
    assert fin.state == "inactive"
    del there.machine.open
    fin.activate()


def test_nothing_moves_without_arm(there):
    parameters = there.parameters.model_copy(update={"arm": False})
    fin = parameters.connect(there.transport, fin_topics("tail"), "tail")
    thread = threading.Thread(target=fin.run)
    thread.start()
    with pytest.raises(RigError, match="nothing moves without --arm"):
        fin.activate()
    fin.shut_down()
    thread.join(HANG_S)
    assert there.machine.commands == []


def test_a_motor_that_stays_on_after_a_deactivation_is_a_stop(there, fin):
    fin.activate()
    there.machine.stop_unconfirmed = "the motor may be on; switch off its supply"
    fin.deactivate()
    assert fin.state == "stopped"
    assert "BUT the motor may be on" in fin.reason


def test_a_machine_that_never_confirms_a_stop_is_deactivated_all_the_same(there, fin):
    there.machine.stop_unconfirmed = "softfin cannot confirm that the motor is off"
    fin.activate()
    fin.deactivate()
    assert fin.state == "inactive"


def test_a_signal_stops_the_fin_and_ends_the_run(there):
    fin = there.parameters.connect(there.transport, fin_topics("tail"), "tail")
    results = []
    thread = threading.Thread(target=lambda: results.append(fin.run()))
    thread.start()
    fin.activate()
    # What the handler of the signal does, which only the main thread may install.
    fin._stop.is_by_signal = True
    fin._stop.trip = Trip("emergency_stop", "stopped by SIGTERM")
    thread.join(HANG_S)
    assert results == [True]
    assert fin.reason == "stopped, motor disabled: stopped by SIGTERM"
    with pytest.raises(RigError, match="stopped by SIGTERM"):
        fin.activate()


def test_parameters_become_the_configuration_of_the_node():
    topics = fin_topics("tail")
    config = FinParameters(reference_timeout_s=0.0, reference_lost="keep").node_config(topics)
    assert config.stop_topic == "/tail/stop"
    assert (config.reference_timeout_s, config.reference_limit_n, config.feedback) == (None,) * 3
    config = FinParameters(reference_limit_n=3.0, feedback=True).node_config(topics)
    assert (config.reference_timeout_s, config.reference_limit_n) == (1.0, 3.0)
    assert config.feedback is not None
    with pytest.raises(ConfigurationError, match="parameter controller: missing"):
        FinParameters().connect(MemoryTransport(), topics, "tail")
