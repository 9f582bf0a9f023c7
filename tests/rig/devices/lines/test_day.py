"""A whole day at an emulated rig whose force sensor sends lines."""

import json
import re

import pytest
import yaml

from softfin.cli import main
from softfin.rig.record import load_record
from tests import needs
from tests.control.folders import folder_option
from tests.rig.rigs import emulated_by_command, over_sockets


@pytest.fixture
def simulated_rig(tmp_path):
    with emulated_by_command(tmp_path / "rig.yaml", "--sensor", "lines") as file:
        yield file


@pytest.fixture
def serial_rig(tmp_path):
    """In real time: the sensor is on a pseudo-terminal. That the drive stops by itself is taken for
    proven, because a busy computer is late for that."""
    needs.module("serial", "pyserial is not installed")
    with over_sockets(tmp_path / "rig.yaml", sensor="lines"):
        yield tmp_path / "rig.yaml"


def test_check_zero_collect_and_evaluate_pass(simulated_rig, tmp_path, capsys):
    main(["rig", "check", "--rig", str(simulated_rig), "--prove", "--arm", "--yes"])
    pass_a_day(simulated_rig, tmp_path, capsys)


@pytest.mark.real_time
def test_the_same_day_passes_over_a_pseudo_terminal(serial_rig, tmp_path, capsys):
    assert yaml.safe_load(serial_rig.read_text())["sensor"]["port"].startswith("/dev/pts/")
    pass_a_day(serial_rig, tmp_path, capsys)


def pass_a_day(rig, tmp_path, capsys):
    told = ["--rig", str(rig)]
    plant = ["--plant", f"rig:{rig}", "--arm", "--yes"]
    assert yaml.safe_load(rig.read_text())["sensor"]["type"] == "lines"
    main(["rig", "zero", *told, "--arm", "--yes"])
    zero = load_record(rig).force_zero
    assert zero.wrench is not None
    capsys.readouterr()
    main(["rig", "check", *told, "--json"])
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    assert {row["state"] for row in rows.values()} <= {"well", "note"}
    # In real time, the measured rate depends on the computer.
    assert re.match(r"lines, [23]\d\d/s, delay ", rows["force sensor"]["text"])
    data = tmp_path / "data"
    counts = ["--logs", "1", "--test-logs", "1", "--rows", "300"]
    main(["collect", *plant, "--out", str(data), *counts])
    described = json.loads((data / "dataset.json").read_text())
    assert described["rig"]["sensor"]["type"] == "lines"
    assert described["sensor_by_log"]["train-0000"]["force_delay_s"] > 0.01
    assert described["sensor_by_log"]["train-0000"]["force_zero"]["wrench"] == list(zero.wrench)
    controller = folder_option("single", tmp_path)
    out = tmp_path / "evaluation"
    shortest = ["--seconds", "3", "--repeats", "1", "--set", "references=[[1.0,-1.0]]"]
    main(["evaluate", str(controller), *plant, "--out", str(out), *shortest])
    assert (out / "evaluation.json").exists()
