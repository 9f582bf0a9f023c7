"""The life-cycle node of one fin, over stand-ins: not run under ROS 2, which is not to be had here.

Each way in which a stop could be lost has a test.
"""

import os
import signal
import threading

import pytest

from softfin.core.errors import DeviceError, SafetyStop
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import SafetyConfig
from softfin.rig.stop import StopRequest, stopped_by_signals
from softfin.stages import driving
from softfin_ros import managed_fin
from softfin_ros.fin_parameters import FinParameters
from tests.cli.test_ros2 import Controller, StillFin
from tests.patience import HANG_S, wait_until
from tests.ros2 import stand_ins
from tests.ros2.stand_ins import FAILURE, SUCCESS

# Recordings, and the waits of real time.
pytestmark = pytest.mark.slow

PATIENT = SafetyConfig().model_copy(
    update=dict.fromkeys(("stale_s", "force_stale_s", "overrun_s", "watchdog_s"), HANG_S)
)
"""Limits that a busy computer keeps."""


class Gate:
    """Lets a thread through, unless the test has shut it; then the thread waits."""

    def __init__(self):
        self.is_open = threading.Event()
        self.is_open.set()
        self.waiting = threading.Event()

    def shut(self):
        self.is_open.clear()
        self.waiting.clear()

    def __call__(self):
        self.waiting.set()
        assert self.is_open.wait(HANG_S)


class GatedFin(StillFin):
    """A fin at which a test may stay, while it opens or stops."""

    def __init__(self):
        super().__init__()
        self.opening = Gate()
        self.stopping = Gate()
        self.on_open = lambda: None
        self.after_close = lambda: None

    def open(self):
        self.opening()
        self.on_open()

    def stop(self):
        self.stops += 1
        self.stopping()

    def close(self):
        self.after_close()


class Parts:
    """A node with its fin; the node is made by the test or by `main`."""

    def __init__(self, modules, made, machine, controller, folder):
        self.modules = modules
        self.made = made
        self.machine = machine
        self.controller = controller
        self.folder = folder
        self.codes = []

    @property
    def node(self):
        return self.made.nodes[0]

    @property
    def executor(self):
        return self.made.executors[0]

    def start(self):
        node = self.modules.fin.FinNode()
        executor = stand_ins.Executor()
        executor.add_node(node)
        self.threads = [
            threading.Thread(target=node.spin, args=(executor,)),
            threading.Thread(target=lambda: self.codes.append(node.run(StopRequest()))),
        ]
        for thread in self.threads:
            thread.start()

    def join(self):
        for gate in (self.machine.opening, self.machine.stopping):
            gate.is_open.set()
        for thread in self.threads:
            thread.join(HANG_S)
            assert not thread.is_alive()

    def reasons(self):
        return [message.data for message in self.node.sent["/tail/stop_reason"]]

    def change(self, *transitions):
        results = [self.node.change_state(transition) for transition in transitions]
        assert results == [SUCCESS] * len(results), self.node.logged

    def in_thread(self, function, *arguments):
        """Start a request, and return the list that receives its result."""
        results = []
        threading.Thread(target=lambda: results.append(function(*arguments)), daemon=True).start()
        return results

    def activate_until_open(self):
        """Start an activation that waits while the devices open; return the list of its result."""
        self.machine.opening.shut()
        results = self.in_thread(self.node.change_state, "activate")
        assert self.machine.opening.waiting.wait(HANG_S)
        return results

    def check_refused(self, reason):
        """Check that an inactive node cannot be activated before the reset."""
        commands = len(self.machine.commands)
        assert self.node.change_state("activate") == FAILURE
        assert self.node.state == "inactive"
        assert reason in self.node.logged[-1]
        assert self.node.logged[-1].endswith("; call the service ~/reset first")
        assert len(self.machine.commands) == commands
        wait_until(lambda: reason in self.reasons()[-1])
        assert self.node.call("~/reset").success
        self.change("activate")


@pytest.fixture
def parts(monkeypatch, tmp_path):
    made = stand_ins.install_rclpy(monkeypatch)
    # A busy computer is no executor that hangs.
    monkeypatch.setattr(managed_fin, "SILENCE_S", HANG_S)
    machine = GatedFin()
    controller = Controller()
    setup = RobotSetup(machine, PATIENT, settle_s=0.02)
    monkeypatch.setattr(driving, "load_controller", lambda folder: controller)
    monkeypatch.setattr(driving, "find_robot", lambda name: setup)
    given = {"controller": "controller", "folder": str(tmp_path), "arm": True}
    monkeypatch.setattr(stand_ins.LifecycleNode, "given", given)
    with stand_ins.imported_nodes() as modules:
        yield Parts(modules, made, machine, controller, tmp_path)


@pytest.fixture
def there(parts):
    """A node, its loop and its executor."""
    parts.start()
    yield parts
    parts.executor.shutdown(0.0)
    parts.join()


def stop_by_service(there):
    assert there.node.call("~/stop").success


def stop_by_topic(there):
    """Once, before many messages that do not request it, which no queue holds."""
    there.node.put_stop(True)
    # `reason` would read the topic.
    wait_until(lambda: there.node._emergency_stop._reason is not None)
    for _ in range(20):
        there.node.put_stop(False)


STOPS = {
    "stopped by the service ~/stop": stop_by_service,
    "emergency stop on /tail/stop": stop_by_topic,
}

each_stop = pytest.mark.parametrize(("reason", "stop"), STOPS.items(), ids=["service", "topic"])


def test_a_node_moves_only_while_it_is_active(there):
    node = there.node

    def states():
        return [message.status[0].message for message in node.sent["/diagnostics"]]

    there.change("configure")
    wait_until(lambda: states()[-1:] == ["inactive"])
    assert there.machine.reads == 0
    assert not there.machine.opening.waiting.is_set()
    assert not any(node.sent[f"/tail/{name}"] for name in ("joint_states", "wrench", "command"))
    for number in (1, 2):
        there.change("activate")
        asked = len(there.controller.asked)
        wait_until(lambda asked=asked: len(there.controller.asked) > asked)
        stops = there.machine.stops
        there.change("deactivate")
        assert there.machine.stops > stops
        reads = there.machine.reads
        wait_until(lambda: states()[-1] == "inactive")
        assert there.machine.reads == reads, "no device is open"
        assert len(list(there.folder.iterdir())) == number
    assert node.logged == []
    assert there.reasons() == [""]
    assert set(states()) <= {"unconfigured", "inactive", "active"}


@each_stop
def test_a_stop_while_unconfigured_is_remembered(there, reason, stop):
    stop(there)
    there.change("configure")
    there.check_refused(reason)


@each_stop
def test_a_stop_while_inactive_is_remembered_over_cleanup_and_configure(there, reason, stop):
    there.change("configure")
    stop(there)
    there.change("cleanup", "configure")
    there.check_refused(reason)


@each_stop
def test_a_stop_while_the_devices_open_is_remembered_and_nothing_moves(there, reason, stop):
    there.change("configure")
    results = there.activate_until_open()
    stop(there)
    there.machine.opening.is_open.set()
    wait_until(lambda: results)
    assert results == [FAILURE]
    assert there.machine.commands == []
    there.check_refused(reason)


@each_stop
def test_a_stop_while_the_devices_fail_to_open_is_remembered(there, reason, stop):
    def fail():
        raise DeviceError("drive: no supply; switch it on")

    there.change("configure")
    there.machine.on_open = fail
    results = there.activate_until_open()
    stop(there)
    there.machine.opening.is_open.set()
    wait_until(lambda: results)
    there.machine.on_open = lambda: None
    there.check_refused(reason)


@each_stop
def test_a_stop_during_the_deactivation_is_remembered(there, reason, stop):
    there.change("configure", "activate")
    there.machine.stopping.shut()
    results = there.in_thread(there.node.change_state, "deactivate")
    assert there.machine.stopping.waiting.wait(HANG_S)
    stop(there)
    there.machine.stopping.is_open.set()
    wait_until(lambda: results)
    assert results == [SUCCESS]
    there.check_refused(reason)


@each_stop
def test_a_stop_of_an_active_fin_deactivates_the_node_until_the_reset(there, reason, stop):
    there.change("configure", "activate")
    stop(there)
    wait_until(lambda: there.node.state == "inactive")
    outcome = f"stopped, motor disabled: {reason}"
    assert there.node.logged == [outcome]
    assert there.reasons()[-1] == outcome
    there.check_refused(reason)


def test_a_reset_of_an_active_fin_is_refused(there):
    there.change("configure", "activate")
    answer = there.node.call("~/reset")
    assert not answer.success
    assert answer.message == "the fin is active; deactivate it first"


@pytest.mark.parametrize("is_latched", [False, True])
def test_a_reset_is_refused_while_the_last_message_requests_the_stop(there, is_latched):
    there.change("configure")
    there.node.put_stop(False)
    there.node.put_stop(True, is_latched)
    answer = there.node.call("~/reset")
    assert not answer.success
    assert "/tail/stop: still requests a stop; publish false" in answer.message
    there.change("cleanup", "configure")
    assert not there.node.call("~/reset").success
    assert there.node.change_state("activate") == FAILURE
    there.node.put_stop(False, is_latched)
    assert there.node.call("~/reset").success
    there.change("activate")


def test_a_true_that_was_latched_before_the_node_started_is_a_stop(parts):
    bool_message = stand_ins.Messages().make("std_msgs/msg/Bool", True)
    node_class = stand_ins.LifecycleNode
    init = node_class.__init__

    def start(self, name):
        init(self, name)
        self.put("/tail/stop", bool_message, latched=True)

    with pytest.MonkeyPatch.context() as patches:
        patches.setattr(node_class, "__init__", start)
        parts.start()
    parts.change("configure")
    assert parts.node.change_state("activate") == FAILURE
    assert not parts.node.call("~/reset").success
    parts.executor.shutdown(0.0)
    parts.join()


def test_the_loop_reads_the_stop_topic_while_the_fin_is_inactive(parts):
    node = parts.modules.fin.FinNode()
    # No executor runs, so no other thread reads it.
    thread = threading.Thread(target=node.run, args=(StopRequest(),))
    thread.start()
    node.put_stop(True)
    wait_until(lambda: parts.reasons()[-1] == "emergency stop on /tail/stop")
    node._fin.end("the end of the test")
    thread.join(HANG_S)
    assert not thread.is_alive()


def end_quietly(executor):
    executor.shutdown(0.0)


def end_by_an_error(executor):
    executor.fail(RuntimeError("context is not valid"))


@pytest.mark.parametrize(
    ("end", "reason"),
    [(end_quietly, "its executor has ended"), (end_by_an_error, "context is not valid")],
)
@pytest.mark.parametrize("transitions", [(), ("configure",), ("configure", "activate")])
def test_the_end_of_the_executor_stops_the_fin_and_ends_the_node(there, end, reason, transitions):
    there.change(*transitions)
    stops = there.machine.stops
    end(there.executor)
    there.join()
    assert there.codes == [3]
    assert reason in there.node.logged[-1]
    assert reason in there.reasons()[-1]
    if "activate" in transitions:
        assert there.machine.stops > stops


def test_an_activation_that_waits_ends_with_the_loop(there):
    there.change("configure")
    results = there.activate_until_open()
    there.executor.shutdown(0.0)
    # The join lets the fin open.
    wait_until(lambda: there.node._emergency_stop.reason() is not None)
    there.join()
    wait_until(lambda: results)
    assert results == [FAILURE]
    assert there.machine.commands == []


def test_zeroing_rests_and_starts_the_controller_again(there):
    assert there.node.call("~/zero").message.startswith("the fin is unconfigured; activate it")
    started = []
    init = there.controller.init
    object.__setattr__(there.controller, "init", lambda: started.append(1) or init())
    there.change("configure", "activate")
    wait_until(lambda: there.controller.asked)
    assert there.node.call("~/zero").success
    assert len(started) == 2
    there.change("deactivate")


@pytest.mark.parametrize("kind", ["deactivate", "stop", "reset"])
def test_requests_go_through_while_the_zeroing_waits(there, kind):
    there.change("configure", "activate")
    wait_until(lambda: there.controller.asked)
    # The controller does not start again before the test lets it.
    gate = Gate()
    gate.shut()
    object.__setattr__(there.controller, "init", gate)
    answers = there.in_thread(there.node.call, "~/zero")
    assert gate.waiting.wait(HANG_S)
    if kind == "stop":
        assert there.node.call("~/stop").success
    elif kind == "reset":
        assert not there.node.call("~/reset").success
    else:
        changes = there.in_thread(there.node.change_state, "deactivate")
        wait_until(lambda: there.node._fin._request.trip is not None)
    assert answers == []
    gate.is_open.set()
    wait_until(lambda: answers)
    if kind == "reset":
        assert answers[0].success
    else:
        assert not answers[0].success
    if kind == "deactivate":
        wait_until(lambda: changes)
        assert changes == [SUCCESS]
        assert there.node.logged == []


def test_a_motor_that_stays_on_after_a_deactivation_is_a_stop_in_the_log(there):
    there.change("configure", "activate")
    there.machine.stop_unconfirmed = "the motor may be on; switch off its supply"
    there.change("deactivate")
    assert len(there.node.logged) == 1
    assert there.node.logged[0].endswith("BUT the motor may be on; switch off its supply")
    there.check_refused("BUT the motor may be on")


def test_a_failure_of_the_previous_stop_does_not_excuse_the_next(there):
    failure = "the motor may be on; switch off its supply"

    def open_anew():
        there.machine.stop_unconfirmed = None

    there.machine.stop_unconfirmed = failure
    there.machine.on_open = open_anew
    there.change("configure", "activate")
    there.machine.stop_unconfirmed = failure
    there.change("deactivate")
    there.check_refused(f"BUT {failure}")


def test_a_machine_that_never_confirms_a_stop_is_deactivated_all_the_same(there):
    there.machine.stop_unconfirmed = "softfin cannot confirm that the motor is off"
    there.change("configure", "activate", "deactivate", "activate", "deactivate")
    assert there.node.logged == []


def test_a_device_that_cannot_be_opened_may_be_tried_again(there):
    def fail():
        raise DeviceError("drive: no supply; switch it on")

    there.change("configure")
    there.machine.on_open = fail
    assert there.node.change_state("activate") == FAILURE
    assert there.node.logged == ["drive: no supply; switch it on"]
    there.machine.on_open = lambda: None
    there.change("activate")


def test_nothing_moves_without_arm(there):
    there.node.values["arm"] = False
    there.change("configure")
    assert there.node.change_state("activate") == FAILURE
    assert "nothing moves without --arm" in there.node.logged[0]
    assert there.machine.commands == []


def raise_error():
    raise ValueError("a bug")


@pytest.mark.parametrize("is_active", [False, True])
def test_any_error_while_the_fin_may_move_is_a_stop(there, is_active):
    there.change("configure")
    if is_active:
        object.__setattr__(there.controller, "init", raise_error)
        there.node.change_state("activate")
        wait_until(lambda: there.node.state == "inactive" and there.node.logged)
        object.__delattr__(there.controller, "init")
    else:
        there.machine.on_open = raise_error
        assert there.node.change_state("activate") == FAILURE
        there.machine.on_open = lambda: None
    there.check_refused("moving the fin failed (ValueError: a bug)")


def test_an_error_in_the_loop_ends_the_node_with_its_reason(there, monkeypatch):
    there.change("configure")
    update = there.node._fin._status.update

    def fail_once(*values):
        monkeypatch.undo()
        raise_error()

    monkeypatch.setattr(there.node._fin._status, "update", fail_once)
    wait_until(lambda: there.codes)
    assert there.node._fin._status.update == update
    assert there.codes == [3]
    reason = "the loop of the node failed (ValueError: a bug); see --debug"
    assert there.node.logged == [reason]
    assert there.reasons()[-1] == reason
    assert there.node.change_state("activate") == FAILURE


def run_main(parts, *transitions, then=lambda: None):
    """Return the exit code of the node after a Ctrl-C that follows these transitions."""

    def interrupt():
        wait_until(lambda: parts.made.executors and parts.executor.nodes)
        parts.change(*transitions)
        then()
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    code = parts.modules.fin.main()
    thread.join(HANG_S)
    assert parts.node.state == "destroyed"
    return code


def test_another_ctrl_c_while_the_node_ends_does_not_change_the_exit_code(parts, monkeypatch):
    def interrupt_again(self, timeout_sec):
        os.kill(os.getpid(), signal.SIGINT)
        self.ended.set()

    def stop():
        assert parts.node.call("~/stop").success

    monkeypatch.setattr(stand_ins.Executor, "shutdown", interrupt_again)
    assert run_main(parts, then=stop) == 3
    assert parts.node.logged[-1] == "stopped by the service ~/stop"


@pytest.mark.parametrize("transitions", [(), ("configure",), ("configure", "activate")])
def test_ctrl_c_stops_the_fin_and_ends_the_node(parts, transitions):
    assert run_main(parts, *transitions) == 0
    assert parts.node.logged == []
    assert bool(parts.machine.stops) == ("activate" in transitions)
    assert parts.executor.num_threads == parts.modules.fin.THREADS


def test_ctrl_c_tells_of_a_motor_that_may_be_on(parts):
    def fail():
        parts.machine.stop_unconfirmed = "the motor may be on; switch off its supply"

    assert run_main(parts, "configure", "activate", then=fail) == 3
    assert parts.node.logged[-1].endswith("BUT the motor may be on; switch off its supply")


def test_ctrl_c_after_a_failed_deactivation_returns_3(parts):
    def fail():
        parts.machine.stop_unconfirmed = "the motor may be on; switch off its supply"
        parts.change("deactivate")

    assert run_main(parts, "configure", "activate", then=fail) == 3
    assert parts.node.logged[-1].endswith("BUT the motor may be on; switch off its supply")


def test_parameters_are_read_only_while_the_node_is_configured(there):
    node = there.node
    assert node.set_parameter("strict", True).successful
    there.change("configure")
    result = node.set_parameter("strict", False)
    assert not result.successful
    assert result.reason == "strict: cannot be changed after configure; clean up the node first"
    assert node.values["strict"]
    assert node.set_parameter("use_sim_time", False).successful
    there.change("cleanup")
    assert node.set_parameter("strict", False).successful


@pytest.mark.parametrize("name", ["arm", "autostart"])
def test_no_other_node_may_arm_or_start_the_fin(there, name):
    before = there.node.values[name]
    result = there.node.set_parameter(name, not before)
    assert result.reason == f"{name}: can only be set at the start; set it when you start the node"
    assert there.node.values[name] is before


def test_a_stop_while_the_motor_is_being_powered_leaves_the_fin_without_a_command(there):
    there.machine.on_enable = lambda: there.node.call("~/stop")
    there.change("configure")
    assert there.node.change_state("activate") == FAILURE
    assert there.machine.commands == []
    there.machine.on_enable = lambda: None
    there.check_refused("stopped by the service ~/stop")


def test_a_stop_on_the_topic_while_the_motor_is_being_powered_does_so_too(there):
    there.machine.on_enable = lambda: there.node.put_stop(True)
    there.change("configure")
    assert there.node.change_state("activate") == FAILURE
    assert there.machine.commands == []


def test_a_stop_is_not_lost_in_a_burst_of_other_messages(parts):
    node = parts.modules.fin.FinNode()
    # No executor runs, so only the messages themselves are noticed.
    node.put_stop(True)
    for _ in range(10):
        node.put_stop(False)
    assert "emergency stop on /tail/stop" in node._emergency_stop.reason()


def test_an_executor_that_hangs_stops_the_fin(there, monkeypatch):
    there.change("configure", "activate")
    monkeypatch.setattr(managed_fin, "SILENCE_S", 0.3)
    _, live = there.node.services["~/stop"]
    with live.lock:
        wait_until(lambda: not there.node._fin.is_wanted)
    assert "no answer from the ROS executor for 0." in there.node._emergency_stop.reason()
    monkeypatch.setattr(managed_fin, "SILENCE_S", HANG_S)


def test_a_fault_before_a_signal_is_not_a_planned_end():
    request = StopRequest()
    request.ask("reference_lost", "no reference for 1 s")
    with stopped_by_signals(request):
        signal.raise_signal(signal.SIGINT)
    assert request.ends_program
    fault = SafetyStop("stopped, motor disabled", "reference_lost", True)
    assert not managed_fin.is_planned(fault, request)


def test_a_signal_before_all_else_is_a_planned_end():
    request = StopRequest()
    with stopped_by_signals(request):
        signal.raise_signal(signal.SIGINT)
    stop = SafetyStop("stopped, motor disabled", "emergency_stop", True)
    assert managed_fin.is_planned(stop, request)


def test_a_wrong_parameter_is_one_line_in_the_log_and_the_node_stays_unconfigured(there):
    there.node.values["reference_lost"] = "hover"
    assert there.node.change_state("configure") == FAILURE
    assert there.node.state == "unconfigured"
    assert "reference_lost" in there.node.logged[0]
    there.node.values["reference_lost"] = "stop"
    there.change("configure")


def test_a_failed_configuration_leaves_no_topics(there, monkeypatch):
    before = {topic: len(each) for topic, each in there.node.subscriptions.items()}
    with monkeypatch.context() as patches:
        # It is called when the topics are there.
        patches.setattr(driving, "say", lambda line: raise_error())
        assert there.node.change_state("configure") == FAILURE
    after = {topic: len(each) for topic, each in there.node.subscriptions.items() if each}
    assert after == before


def test_each_parameter_has_a_description(there):
    assert there.node.descriptions.keys() == FinParameters.model_fields.keys()
    assert all(there.node.descriptions.values())


def test_a_node_may_configure_and_activate_itself(parts, monkeypatch):
    given = parts.modules.fin.FinNode.given
    monkeypatch.setattr(stand_ins.LifecycleNode, "given", {**given, "autostart": True})
    parts.start()
    wait_until(lambda: parts.node.state == "active")
    assert parts.machine.commands
    parts.executor.shutdown(0.0)
    parts.join()


def test_a_shutdown_stops_the_fin(there):
    there.change("configure", "activate", "shutdown")
    assert there.node.state == "finalized"
    assert there.machine.stops


def test_two_recordings_of_one_second_have_different_names(there, monkeypatch):
    monkeypatch.setattr(managed_fin.time, "strftime", lambda pattern: "20260102-030405")
    there.change("configure")
    for _ in range(3):
        there.change("activate", "deactivate")
    names = sorted(path.name for path in there.folder.iterdir())
    stem = "tail-20260102-030405"
    assert names == [f"{stem}-2.mcap", f"{stem}-3.mcap", f"{stem}.mcap"]


def test_the_stand_in_keeps_the_life_cycle(there):
    with pytest.raises(RuntimeError, match="no transition activate in the state unconfigured"):
        there.node.change_state("activate")
    with pytest.raises(RuntimeError, match="no transition cleanup in the state active"):
        there.change("configure", "activate", "cleanup")
