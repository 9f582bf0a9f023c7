"""The robot's node between a wrench and four fins, on a clock of its own; and over DDS with another
process."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError, SafetyStop, SoftfinError
from softfin.rig.ros2.config import NodeConfig
from softfin.rig.ros2.node import RosNode
from softfin.rig.stop import StopRequest, stopped_by_signals
from softfin.robot.description import load_robot
from softfin.robot.evaluate import fin_references
from softfin.robot.node import RobotNode
from softfin.robot.node_config import RobotNodeConfig
from tests import needs
from tests.patience import HANG_S
from tests.rig.ros2_memory import MemoryTransport
from tests.rig.ros2_processes import within

FINS = ("front_right", "back_right", "back_left", "front_left")
WRENCH = (1.0, 0.5, 0.0, 0.0, 0.0, 0.1)


class SteppedClock(Clock):
    """Time passes where somebody sleeps, and the others act."""

    def __init__(self):
        self.now = 100.0
        self.others = lambda: None

    def __call__(self):
        return self.now

    def wall(self):
        return 1.7e9 + self.now

    def sleep(self, seconds):
        self.now += seconds
        self.others()


class Pool:
    """U-CAT's node, the nodes of its fins, and somebody who asks for a wrench ten times a
    second."""

    def __init__(self, silent_fin="stop", brace_n=1.5, **changes):
        self.robot = load_robot("ucat").merged(
            {"silent_fin": silent_fin, "allocation": {"brace_n": brace_n}}, "test"
        )
        self.clock = SteppedClock()
        self.told = []
        self.request = StopRequest()
        self.transport = MemoryTransport(self.clock)
        self.sent = self.transport.sent
        self.messages = self.transport.messages
        config = RobotNodeConfig.build({"max_thrust": 4.0, "wait_s": 5.0} | changes)
        self.node = RobotNode(self.transport, self.robot, config, self.told.append, self.clock)
        self.alive = set(FINS)
        self.obey = True
        self.wrench = WRENCH
        self.frame = "base_link"
        self.joint = self.messages.encode(self.messages.joint(1, "", "fin", 0.1, 0.2))
        self.plan = []
        self.asked_at = 0.0
        self.clock.others = self.step

    def at(self, seconds, act):
        """Plan what happens so many seconds after the start."""
        self.plan.append((100.0 + seconds, act))

    def step(self):
        for moment, act in [each for each in self.plan if each[0] <= self.clock.now]:
            self.plan.remove((moment, act))
            act()
        stopped = {
            name for name in self.alive if any(stop.data for stop in self.sent[f"/{name}/stop"])
        }
        if self.obey:
            self.alive -= stopped
        for name in self.alive:
            self.transport.put(f"/{name}/joint_states", self.joint)
        if self.wrench is not None and self.clock.now >= self.asked_at:
            self.asked_at = self.clock.now + 0.1
            self.transport.put("/robot/reference", self.messages.wrench(5, self.frame, self.wrench))

    def stop(self, told=True):
        self.transport.put("/robot/stop", self.messages.make("std_msgs/msg/Bool", told))

    def run(self, seconds=4.0):
        """Run for so long; what the node raises at the end, with a stop sent to every fin."""
        self.at(seconds, lambda: self.request.ask("emergency_stop", "the end"))
        with pytest.raises(SoftfinError) as raised:
            self.node.run(self.request)
        for name in FINS:
            assert self.sent[f"/{name}/stop"][-1].data
            assert self.sent[f"/{name}/reference"][-1].wrench.force.x == 0
        return raised.value

    def forces(self, name):
        """References of a fin, without those of the end [N]."""
        actions = len(self.sent["/robot/wrench"])
        vectors = [message.wrench.force for message in self.sent[f"/{name}/reference"]]
        return np.array([(vector.x, vector.y) for vector in vectors[:actions]])

    def together(self):
        """Wrench of the fins' references, action by action."""
        return (
            np.concatenate([self.forces(name) for name in self.robot.fins], axis=1)
            @ self.robot.matrix().T
        )

    def achieved(self):
        parts = [message.wrench for message in self.sent["/robot/wrench"]]
        return np.array(
            [(p.force.x, p.force.y, p.force.z, p.torque.x, p.torque.y, p.torque.z) for p in parts]
        )

    def saturated(self):
        return [message.data for message in self.sent["/robot/saturated"]]


def test_four_references_make_the_wrench_that_is_asked_for():
    pool = Pool()
    assert str(pool.run()) == "the end; a stop was sent to every fin"
    together = pool.together()
    # Three actions a second, of which each goes half the way.
    assert len(together) == 12
    np.testing.assert_allclose(together[0], np.array(WRENCH) / 2, atol=0.01)
    np.testing.assert_allclose(together[-1], WRENCH, atol=0.01)
    np.testing.assert_allclose(pool.achieved(), together, atol=1e-9)
    assert pool.saturated() == [False] * 12
    assert {message.header.frame_id for message in pool.sent["/robot/wrench"]} == {"base_link"}
    assert {message.header.frame_id for message in pool.sent["/back_left/reference"]} == {""}
    assert all(np.hypot(*pool.forces(name)[-1]) > 1.4 for name in FINS), (
        "fins that push brace themselves"
    )


@pytest.mark.parametrize("dead", [None, "back_left"])
def test_the_evaluation_has_the_references_that_the_node_sends(dead):
    pool = Pool(silent_fin="dead")
    if dead is not None:
        pool.alive.discard(dead)
    pool.run(12.0)
    sent = np.stack([pool.forces(name) for name in FINS], axis=1)
    indices = [] if dead is None else [FINS.index(dead)]
    evaluated = fin_references(pool.robot, [4.0] * 4, indices, np.array(WRENCH), ticks=2000)
    assert len(sent) > 10
    np.testing.assert_allclose(sent, evaluated.forces[: len(sent)], atol=1e-12)
    np.testing.assert_allclose(pool.achieved(), evaluated.wrench[: len(sent)], atol=1e-12)
    assert sent[-1].any(axis=1).tolist() == [name != dead for name in FINS]


def test_the_node_of_a_fin_takes_its_reference_and_its_stop():
    pool = Pool()
    transport = MemoryTransport(pool.clock)
    config = NodeConfig(
        reference_topic="/front_left/reference",
        stop_topic="/front_left/stop",
        frame="front_left_mount",
    )
    fin = RosNode(transport, config, print, clock=pool.clock)
    pool.run()
    forces = pool.forces("front_left")
    transport.put("/front_left/reference", pool.sent["/front_left/reference"][len(forces) - 1])
    assert fin.reference() == pytest.approx(tuple(forces[-1]))
    assert fin.stop_reason() is None
    transport.put("/front_left/stop", pool.sent["/front_left/stop"][0])
    assert fin.stop_reason() == "emergency stop on /front_left/stop"


def test_what_is_beyond_the_fins_is_told_once_and_flagged():
    pool = Pool()
    pool.wrench = (0.0, 30.0, 0.0, 0.0, 0.0, 0.0)
    pool.run()
    assert pool.saturated() == [True] * 12
    assert 7 < pool.achieved()[-1, 1] < 9
    assert sum("out of reach of the fins in sway" in line for line in pool.told) == 1
    assert max(np.hypot(*pool.forces(name).T).max() for name in FINS) <= 4 + 1e-9


def test_one_reach_for_each_fin_is_kept():
    pool = Pool(max_thrust={name: 1.0 + n for n, name in enumerate(FINS)}, fin_prefix="")
    pool.wrench = (30.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    pool.run()
    for reach, name in enumerate(FINS, 1):
        assert np.hypot(*pool.forces(name).T).max() <= reach + 1e-9


def test_wrenches_that_end_stop_every_fin():
    pool = Pool(reference_timeout_s=0.5)
    pool.at(2.0, lambda: setattr(pool, "wrench", None))
    error = pool.run(8.0)
    assert isinstance(error, SafetyStop)
    assert str(error).startswith(
        "/robot/reference: no wrench for 0.5 s; a stop was sent to every fin"
    )
    assert not pool.alive
    assert pool.clock.now < 104


def test_a_robot_that_nobody_has_asked_for_a_wrench_yet_waits():
    pool = Pool(reference_timeout_s=0.5)
    pool.wrench = None
    assert str(pool.run(8.0)) == "the end; a stop was sent to every fin"


def test_without_a_new_wrench_the_fins_may_be_asked_for_nothing():
    pool = Pool(reference_timeout_s=0.5, reference_lost="zero")
    pool.at(2.0, lambda: setattr(pool, "wrench", None))
    pool.run()
    together = pool.together()
    assert together[5].any()
    assert all(not pool.forces(name)[-3:].any() for name in FINS)
    assert not together[-1].any()
    assert sum("no reference for 0.5 s" in line for line in pool.told) == 1


@pytest.mark.parametrize(
    ("wrench", "frame", "told"),
    [
        ((np.nan, 0, 0, 0, 0, 0), "base_link", "its force x is nan"),
        ((0, 0, 0, 0, np.inf, 0), "", "its torque y is inf"),
        ((1e300, 0, 0, 0, 0, 0), "", "a component exceeds 1e+06 N or N m"),
        (WRENCH, "map", "its frame is 'map', expected 'base_link'"),
    ],
)
def test_a_wrench_that_cannot_be_is_refused_in_words_once(wrench, frame, told):
    pool = Pool(reference_timeout_s=60.0)

    def ask():
        pool.wrench = wrench
        pool.frame = frame

    pool.at(2.0, ask)
    pool.run()
    assert sum(told in line for line in pool.told) == 1
    np.testing.assert_allclose(pool.together()[-1], WRENCH, atol=0.01)


def test_a_silent_fin_stops_the_robot():
    pool = Pool()
    pool.at(1.0, lambda: pool.alive.discard("back_left"))
    error = pool.run()
    assert isinstance(error, SafetyStop)
    assert str(error).startswith("back_left is silent: ")
    assert str(error).endswith("a stop was sent to every fin")
    assert 101.5 <= pool.clock.now < 103, "the others obeyed"


def test_a_silent_fin_that_may_be_dead_is_and_the_others_go_on():
    pool = Pool(silent_fin="dead")
    pool.at(1.0, lambda: pool.alive.discard("back_left"))
    # A fin that comes back is stopped.
    pool.at(3.0, lambda: pool.alive.add("back_left"))
    assert "the end" in str(pool.run(8.0))
    dead = [line for line in pool.told if "declared dead" in line]
    assert len(dead) == 1
    assert dead[0].startswith("back_left is silent")
    np.testing.assert_allclose(pool.achieved()[-1], WRENCH, atol=0.01)
    assert not any(vector.wrench.force.x for vector in pool.sent["/back_left/reference"][6:])
    assert len(pool.sent["/front_left/stop"]) < 110 < 8 * 100, "only at the end"
    assert "back_left" not in pool.alive


def test_a_robot_whose_fins_are_all_dead_ends():
    pool = Pool(silent_fin="dead")
    pool.at(1.0, pool.alive.clear)
    error = pool.run()
    assert isinstance(error, SafetyStop)
    assert str(error).endswith("no fins are left")


def test_fins_that_are_not_there_at_the_start_are_told_in_one_line():
    pool = Pool()
    pool.alive.discard("front_left")
    pool.transport.readers["/back_left/reference"] = 0
    error = pool.run(20.0)
    assert isinstance(error, DeviceError)
    assert "no subscriber on /back_left/reference, " in str(error)
    assert "no publisher on /front_left/joint_states" in str(error)
    assert "\n" not in str(error)
    assert not pool.achieved().size


def test_a_fin_that_is_not_there_at_the_start_may_be_dead():
    pool = Pool(silent_fin="dead")
    pool.alive.discard("front_left")
    pool.run(12.0)
    assert sum("front_left is missing" in line for line in pool.told) == 1
    np.testing.assert_allclose(pool.achieved()[-1], WRENCH, atol=0.01)


def test_a_wrench_from_before_the_start_does_not_count():
    pool = Pool(reference_lost="zero")
    pool.alive.discard("front_left")
    pool.at(1.0, lambda: setattr(pool, "wrench", None))
    pool.at(3.0, lambda: pool.alive.add("front_left"))
    pool.run(6.0)
    assert not pool.together().any()


def test_fins_that_come_late_are_waited_for():
    pool = Pool()
    pool.alive.discard("front_left")
    pool.at(3.0, lambda: pool.alive.add("front_left"))
    pool.run(6.0)
    assert len(pool.achieved()) == pytest.approx(9, abs=1)


@pytest.mark.parametrize("waiting", [False, True])
def test_a_stop_is_passed_on_to_every_fin(waiting):
    pool = Pool()
    if waiting:
        pool.alive.discard("front_left")
    pool.at(1.0, lambda: pool.stop(False))
    pool.at(1.5, pool.stop)
    error = pool.run()
    assert isinstance(error, SafetyStop)
    assert str(error) == "emergency stop on /robot/stop; a stop was sent to every fin"
    assert not pool.alive
    assert 101.5 <= pool.clock.now < 103


def test_a_stop_that_cannot_be_read_stops_too():
    pool = Pool()
    pool.at(1.0, lambda: pool.transport.put("/robot/stop", b"\x00\x01\x00\x00"))
    assert "not a valid std_msgs/msg/Bool" in str(pool.run())


def test_a_transport_that_ends_is_a_stop():
    pool = Pool()
    pool.at(1.0, lambda: setattr(pool.transport, "failing", True))
    with pytest.raises(SafetyStop, match="cannot receive messages"):
        pool.node.run(pool.request)


def test_a_node_that_hears_nothing_keeps_sending_its_stops():
    pool = Pool()
    pool.obey = False
    pool.at(1.0, lambda: setattr(pool.transport, "is_deaf", True))
    with pytest.raises(SafetyStop, match="cannot receive messages"):
        pool.node.run(pool.request)
    for name in FINS:
        assert len(pool.transport.sent[f"/{name}/stop"]) > 20


def test_a_later_ctrl_c_does_not_cut_short_the_stop_of_the_fins(monkeypatch):
    monkeypatch.setattr("softfin.rig.stop.PATIENCE_S", -1.0)
    pool = Pool()
    pool.obey = False
    pool.at(2.5, lambda: signal.raise_signal(signal.SIGINT))
    with stopped_by_signals(pool.request):
        error = pool.run(seconds=1.0)
    assert str(error) == "the end; a stop was sent to every fin"
    assert "still publishing" in pool.told[-1]


def test_fins_that_do_not_stop_are_named():
    pool = Pool()
    pool.obey = False
    pool.run(2.0)
    assert pool.told[-1].startswith(f"{', '.join(FINS)}: still publishing 3 s after the stop")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"max_thrust": None}, "max_thrust: missing"),
        ({"max_thrust": {"front_left": 3.0}}, "max_thrust is for front_left, .* front_right, "),
        ({"stop_topic": "/front_left/stop"}, "/front_left/stop is used for two topics"),
        ({"fin_prefix": "ucat"}, "fin_prefix"),
        ({"wrench_topic": "/robot/reference"}, "/robot/reference is used for two topics"),
    ],
)
def test_what_cannot_be_configured_is_told(changes, told):
    with pytest.raises(SoftfinError, match=told):
        Pool(**changes)


def test_a_fin_whose_name_cannot_be_a_topics_is_refused():
    robot = load_robot("ucat")
    fins = {"left fin": next(iter(robot.fins.values()))}
    named = robot.model_copy(update={"fins": fins})
    with pytest.raises(SoftfinError, match="fin 'left fin'"):
        RobotNode(MemoryTransport(), named, RobotNodeConfig(max_thrust=1.0), print)


def test_the_node_and_the_check_need_no_jax():
    code = (
        "import sys, softfin.stages.robot, softfin.stages.driving\n"
        "from softfin.cli import main\n"
        "from softfin.robot.node import RobotNode\n"
        "from softfin.robot.node_config import RobotNodeConfig\n"
        "from softfin.robot.description import load_robot\n"
        "from tests.rig.ros2_memory import MemoryTransport\n"
        "node = RobotNode(MemoryTransport(), load_robot('ucat'), RobotNodeConfig(max_thrust=4), "
        "print)\n"
        "node.send_references()\n"
        "main(['robot', 'check', 'ucat', '--max-thrust', '3'])\n"
        "assert 'jax' not in sys.modules and 'equinox' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG_S
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.real_time
def test_another_process_asks_for_a_wrench_and_plays_the_fins(tmp_path):
    needs.module("cyclonedds", "the extra ros2 is not installed")
    told = within("robot", tmp_path)
    matrix = load_robot("ucat").matrix()
    np.testing.assert_allclose(matrix @ np.ravel([told[name] for name in FINS]), WRENCH, atol=0.02)
    np.testing.assert_allclose(told["achieved"], WRENCH, atol=0.02)
    assert told["saturated"] is False
    assert told["error"] == "emergency stop on /robot/stop; a stop was sent to every fin"
    assert told["stopped"] == sorted(FINS)
