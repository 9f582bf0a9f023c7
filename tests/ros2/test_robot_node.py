"""The node of a robot over stand-ins: not run under ROS 2, which is not to be had here."""

import threading

import pytest

from softfin.robot.description import load_robot
from tests.patience import HANG_S, wait_until
from tests.ros2 import stand_ins


@pytest.fixture
def made(monkeypatch):
    monkeypatch.setattr(stand_ins.LifecycleNode, "namespace", "/robot")
    given = {"max_thrust": 3.0, "fin_prefix": ""}
    monkeypatch.setattr(stand_ins.LifecycleNode, "given", given)
    return stand_ins.install_rclpy(monkeypatch)


def run(made, then):
    """Return the exit code of the node and the node; `then` happens when it listens."""

    def act():
        wait_until(lambda: made.executors and made.nodes[0].subscriptions["/robot/stop"])
        then(made)

    thread = threading.Thread(target=act)
    thread.start()
    with stand_ins.imported_nodes() as modules:
        code = modules.robot.main()
    thread.join(HANG_S)
    return code, made.nodes[0]


def fail(made):
    made.executors[0].fail(RuntimeError("context is not valid"))


def stop(made):
    made.nodes[0].put_stop(True)


@pytest.mark.parametrize(
    ("then", "reason"),
    [(fail, "context is not valid"), (stop, "emergency stop on /robot/stop")],
)
def test_a_stop_and_the_end_of_the_executor_stop_every_fin(made, then, reason):
    code, node = run(made, then)
    assert code == 3
    assert reason in node.logged[-1]
    for name in load_robot("ucat").fins:
        assert [message.data for message in node.sent[f"/{name}/stop"]][-1]
    (mounts,) = node.sent["/tf_static"]
    assert len(mounts.transforms) == len(load_robot("ucat").fins)
    assert node.state == "destroyed"


def test_a_wrong_parameter_is_one_line_and_exit_code_2(made, monkeypatch):
    monkeypatch.setattr(stand_ins.LifecycleNode, "given", {"max_thrust": -1.0})
    with stand_ins.imported_nodes() as modules:
        assert modules.robot.main() == 2
    assert "max_thrust" in made.nodes[0].logged[0]
