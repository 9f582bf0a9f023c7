"""``softfin robot`` as a user types it."""

import json
import time

import pytest
import yaml

from softfin.cli import main
from softfin.robot.description import load_robot
from tests.rig.ros2_memory import MemoryTransport


def refused(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(["robot", *words])
    assert stop.value.code == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    return told


def test_check_prints_rank_and_reach(capsys):
    main(["robot", "check", "ucat"])
    told = capsys.readouterr().out
    assert "U-CAT: 4 fins, rank 6 of 6" in told
    assert "without back_left: rank 6" in told
    assert (
        "self-righting with 9.07 N m/rad: oscillates in roll at 0.89 Hz and pitch at 0.37 Hz"
        in told
    )
    assert "warning" not in told


def test_check_warns_of_a_body_that_does_not_stay_upright(capsys, tmp_path, ucat_file):
    file = tmp_path / "unstable.yaml"
    file.write_text(
        ucat_file.replace(
            "centre_of_buoyancy_m: [0, 0, 0.03]", "centre_of_buoyancy_m: [0, 0, -0.03]"
        )
    )
    main(["robot", "check", str(file)])
    assert (
        "warning: body: unstable in roll and pitch: weight and buoyancy turn it"
        in capsys.readouterr().out
    )


@pytest.mark.slow
def test_evaluate_writes_figures_and_a_page(capsys, tmp_path):
    out = tmp_path / "out"
    main(
        [
            "robot",
            "evaluate",
            "ucat",
            "--task",
            "hold",
            "--task",
            "wrenches",
            "--repeats",
            "1",
            "--out",
            str(out),
            "--json",
            "--set",
            "hold_s=20",
            "--set",
            "settled_s=6",
            "--set",
            "wrenches=2",
        ]
    )
    found = json.loads(capsys.readouterr().out)
    assert found["wrenches"]["count"] == 2
    assert json.loads((out / "robot.json").read_text())["hold"][0]["seed"] == 0
    assert {file.name for file in out.iterdir()} == {
        "robot.json",
        "hold.html",
        "hold.png",
        "hold.svg",
    }
    page = (out / "hold.html").read_text()
    # Nothing is fetched; the library is in the page, with its licence.
    assert "src=" not in page
    assert "data:text/javascript;base64," in page


@pytest.mark.slow
def test_view_writes_a_page(capsys, tmp_path):
    page = tmp_path / "lem.html"
    main(
        [
            "robot",
            "view",
            "--task",
            "lemniscate",
            "--out",
            str(page),
            "--set",
            "path_s=20",
            "--set",
            "settled_s=5",
        ]
    )
    assert "lemniscate" in capsys.readouterr().out
    assert page.stat().st_size < 2_500_000


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("check", "ucat", "--task", "hold"), "--task: unknown option"),
        (("view", "--task", "wrenches"), "--task wrenches: must be one of hold, lemniscate"),
        (("view", "ucat", "--out", "robot.gif"), "must end in .html"),
        (("evaluate", "nemo.yaml"), "nemo.yaml: file not found"),
        (("evaluate", "--set", "seeds=0"), "seeds"),
        (("evaluate", "--set", "hold_s=60"), "must be at least 90.34 s with settled_s = 30"),
        (("ros2", "ucat"), "max_thrust: missing"),
        (
            ("ros2", "ucat", "--set", "max_thrust=3", "--set", "stop_topic=stop"),
            "stop_topic = 'stop'",
        ),
        (
            ("ros2", "ucat", "--set", "max_thrust.tail=3"),
            "max_thrust is for tail, but U-CAT has front_right",
        ),
        (("ros2", "ucat", "--domain", "300"), "connection.domain = 300"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(capsys, transport, words, told):
    assert told in refused(capsys, *words)


def test_fins_that_the_simulation_does_not_know_are_refused(capsys, tmp_path, ucat_file):
    text = ucat_file.replace(
        "    shaft_axis: [0.5, 0.8660254, 0]",
        "    shaft_axis: [0.5, 0.8660254, 0]\n    range_rad: [-1, 1]",
    )
    file = tmp_path / "limited.yaml"
    file.write_text(text)
    assert "front_left has a limited range" in refused(capsys, "evaluate", str(file))


@pytest.fixture
def transport(monkeypatch):
    transport = MemoryTransport(time.monotonic)
    monkeypatch.setattr("softfin.rig.ros2.plant.open_transport", lambda config: transport)
    return transport


def test_a_stop_by_its_topic_ends_the_node_with_the_exit_code_of_a_stop(capsys, transport):
    transport.put("/robot/stop", transport.messages.make("std_msgs/msg/Bool", True))
    with pytest.raises(SystemExit) as stop:
        main(["robot", "ros2", "ucat", "--set", "max_thrust=3"])
    assert stop.value.code == 3
    told = capsys.readouterr().err
    assert "in memory" in told
    assert told.endswith(
        "softfin robot ros2: emergency stop on /robot/stop; every fin was told to stop\n"
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
                "--set",
                "max_thrust=3",
                "--set",
                "wait_s=0.1",
                "--set",
                "fin_prefix=/ucat",
            ]
        )
    assert stop.value.code == 1
    assert (
        "after 0.1 s no publisher on /ucat/front_right/joint_states, "
        in capsys.readouterr().err.splitlines()[-1]
    )


@pytest.fixture
def ucat_file():
    from importlib.resources import files

    return files("softfin.robot").joinpath("robots/ucat.yaml").read_text()


def test_fins_of_tanks_that_are_not_alike_are_refused(capsys, tmp_path):
    (tmp_path / "tank.yaml").write_text("fin: {plates: 2}\n")
    robot = load_robot("ucat").model_dump(mode="json")
    robot["fins"]["back_left"]["plant"] = str(tmp_path / "tank.yaml")
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(robot))
    assert "same number of plates" in refused(capsys, "check", str(tmp_path / "robot.yaml"))
