"""An emulated rig with an EPOS2 and a force sensor behind a ROS 2 topic, by the commands."""

import json

import pytest
import yaml

from softfin.cli import main
from softfin.rig.record import load_record
from tests.rig.rigs import emulated_by_command


@pytest.fixture
def rig(tmp_path):
    with emulated_by_command(tmp_path / "rig.yaml", "--sensor", "ros2") as file:
        yield file


def test_check_zero_and_collect_pass_and_the_zero_is_found_again(rig, tmp_path, capsys):
    told = ["--rig", str(rig)]
    written = yaml.safe_load(rig.read_text())
    assert written["sensor"]["type"] == "ros2"
    assert written["drive"]["type"] == "epos2"
    main(["rig", "check", *told, "--prove", "--arm", "--yes"])
    main(["rig", "zero", *told, "--arm", "--yes"])
    zero = load_record(rig).force_zero
    assert zero.wrench is not None
    capsys.readouterr()
    main(["rig", "check", *told, "--json"])
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["force sensor"]["text"].startswith("WrenchStamped in the frame 'ft_sensor', 320/s,")
    assert {row["state"] for row in rows.values()} <= {"well", "note"}
    data = tmp_path / "data"
    counts = ["--logs", "1", "--test-logs", "1", "--rows", "300"]
    main(["collect", "--plant", f"rig:{rig}", "--arm", "--yes", "--out", str(data), *counts])
    described = json.loads((data / "dataset.json").read_text())
    assert described["rig"]["sensor"]["type"] == "ros2"
    assert described["sensor_by_log"]["train-0000"]["force_delay_s"] > 0.01
    assert described["sensor_by_log"]["train-0000"]["force_zero"]["wrench"] == list(zero.wrench)
