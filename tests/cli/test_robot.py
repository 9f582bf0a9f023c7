"""``softfin robot`` as a user types it."""

import json
import shutil
import time

import pytest
import yaml

from softfin.cli import main
from softfin.stages.example import EXAMPLE
from tests.rig.ros2_memory import MemoryTransport
from tests.staged import COARSE
from tests.test_golden import check_keys

GAITS = str(EXAMPLE / "gaits")


def refused(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(["robot", *words])
    assert stop.value.code == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    return told


def test_check_prints_rank_and_reach(capsys):
    main(["robot", "check", "ucat", "--max-thrust", "3"])
    told = capsys.readouterr().out
    assert "U-CAT: 4 fins, rank 6 of 6" in told
    assert "without back_left: rank 6" in told
    assert "heave  up to 12.00 N" in told


@pytest.fixture
def gaits(tmp_path):
    """A coarse tank, and gaits that claim to reach every force."""
    plant = tmp_path / "coarse.yaml"
    plant.write_text(yaml.safe_dump(COARSE))
    controller = tmp_path / "gaits"
    shutil.copytree(EXAMPLE / "gaits", controller)
    description = json.loads((controller / "controller.json").read_text())
    description["reachable"] |= {"centre_n": [0, 0], "radius_n": [6] * 32}
    description["lattice"] |= {"low_n": [-6, -6], "high_n": [6, 6]}
    (controller / "controller.json").write_text(json.dumps(description))
    return str(controller), "--plant", str(plant)


def test_evaluate_prints_and_writes_the_errors_of_each_axis(capsys, tmp_path, gaits):
    out = tmp_path / "out"
    words = ["evaluate", "ucat", *gaits, "--out", str(out), "--dead", "back_left"]
    sizes = ["--targets", "2", "--repeats", "1", "--max-thrust", "3"]
    main(["robot", *words, *sizes])
    told = capsys.readouterr().out
    assert "U-CAT, back_left dead: 2 target wrenches, 1 times 20 s" in told
    assert [file.name for file in out.iterdir()] == ["robot.json"]
    check_keys(out)
    found = json.loads((out / "robot.json").read_text())
    assert found["configuration"]["dead"] == "back_left"
    for axis, error in found["error"].items():
        line = next(line for line in told.splitlines() if line.startswith(axis))
        assert f"{error:.3f}" in line.split()


def test_controllers_are_for_all_fins_or_for_each(capsys, gaits):
    controller, *plant = gaits
    told = refused(capsys, "evaluate", "ucat", controller, controller, *plant)
    assert "got 2 controllers; use one for all fins, or one for each of front_right" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("check", "ucat"), "max_thrust: missing"),
        (("check", "nemo.yaml", "--max-thrust", "3"), "nemo.yaml: file not found"),
        (("evaluate", "ucat"), "got 0 controllers; use one for all fins"),
        (("evaluate", "ucat", GAITS), "max_thrust: missing"),
        (("evaluate", "ucat", GAITS, "--repeats", "0"), "repeats"),
        (("evaluate", "ucat", GAITS, "--plant", "tests.plants:AnalyticFin"), "only a tank"),
        (
            ("evaluate", "ucat", GAITS, "--max-thrust", "3", "--dead", "tail"),
            "dead = tail: unknown fin",
        ),
        (("ros2", "ucat"), "max_thrust: missing"),
        (
            ("ros2", "ucat", "--max-thrust", "3", "--stop-topic", "stop"),
            "stop_topic = 'stop'",
        ),
        (
            ("ros2", "ucat", "--max-thrust.tail", "3"),
            "max_thrust is for tail, but U-CAT has front_right",
        ),
        (("ros2", "ucat", "--domain", "300"), "--domain 300"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(capsys, transport, words, told):
    assert told in refused(capsys, *words)


@pytest.fixture
def transport(monkeypatch):
    transport = MemoryTransport(time.monotonic)
    monkeypatch.setattr("softfin.rig.ros2.plant.open_transport", lambda config: transport)
    return transport


def test_a_stop_by_its_topic_ends_the_node_with_the_exit_code_of_a_stop(capsys, transport):
    transport.put("/robot/stop", transport.messages.make("std_msgs/msg/Bool", True))
    with pytest.raises(SystemExit) as stop:
        main(["robot", "ros2", "ucat", "--max-thrust", "3"])
    assert stop.value.code == 3
    told = capsys.readouterr().err
    assert "in memory" in told
    assert told.endswith(
        "softfin robot ros2: emergency stop on /robot/stop; a stop was sent to every fin\n"
    )
    assert all(
        transport.sent[f"/{name}_{side}/stop"][-1].data
        for name in ("front", "back")
        for side in ("left", "right")
    )
    assert transport.closed


def test_fins_that_are_not_there_end_the_node_in_one_line(capsys, transport):
    with pytest.raises(SystemExit) as stop:
        main(
            [
                "robot",
                "ros2",
                "ucat",
                "--max-thrust",
                "3",
                "--wait-s",
                "0.1",
                "--fin-prefix",
                "/ucat",
            ]
        )
    assert stop.value.code == 1
    assert (
        "after 0.1 s no publisher on /ucat/front_right/joint_states, "
        in capsys.readouterr().err.splitlines()[-1]
    )
