"""A whole day at an emulated rig with a Dynamixel and a force sensor that sends lines."""

import json

import pyarrow.parquet as pq
import pytest
import yaml

from softfin.cli import main
from softfin.emulation.dynamixel import MOUNTED_TICKS
from softfin.emulation.rig import rigs
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.record import load_record
from tests.cli.test_cli import fails
from tests.control.folders import folder_option
from tests.rig.bags import counts_of
from tests.rig.rigs import emulated_by_command


@pytest.fixture
def rig(tmp_path):
    with emulated_by_command(
        tmp_path / "rig.yaml", "--drive", "dynamixel", "--sensor", "lines"
    ) as file:
        yield file


def test_check_zero_collect_and_evaluate_pass(rig, tmp_path, capsys):
    options = ["--rig", str(rig)]
    plant = ["--plant", f"rig:{rig}", "--arm", "--yes"]
    values = yaml.safe_load(rig.read_text())
    assert values["drive"]["type"] == "dynamixel"
    assert "bus" not in values
    # Zeroing does not power the motor, so it needs no proof, but the proof depends on the zero.
    main(["rig", "zero", *options, "--arm", "--yes"])
    assert "own_stop: rig of emulated: no proof yet" in capsys.readouterr().out
    main(["rig", "check", *options, "--prove", "--arm", "--yes"])
    proof = load_record(rig).stop_proof
    assert 0.1 <= proof.faulted_after_s <= 0.15
    assert proof.drive["firmware"] == 48
    assert proof.drive["homing_offset"] == -MOUNTED_TICKS
    capsys.readouterr()
    # The next command starts from the state file: the servo has kept its zero.
    rigs.pop(rig.resolve()).close()
    main(["rig", "check", *options, "--json"])
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["drive"]["text"].startswith("XM430-W350, simulated, ID 1: limits read, supply 12")
    assert rows["zero"]["text"] == "known"
    assert rows["own stop"]["state"] == "well"
    assert "Bus Watchdog (98) is 4" in rows["own stop"]["text"]
    assert {row["state"] for row in rows.values()} <= {"well", "note"}
    data = tmp_path / "data"
    counts = ["--logs", "1", "--test-logs", "1", "--rows", "300"]
    main(["collect", *plant, "--out", str(data), *counts])
    described = json.loads((data / "dataset.json").read_text())
    assert described["rig"]["drive"]["type"] == "dynamixel"
    log = pq.read_table(data / "train" / "0000.parquet")
    assert log["voltage_v"].to_numpy() == pytest.approx(12.0)
    bags = data.with_name("data-bags")
    assert counts_of(bags / "train-0000.mcap")["/fin/channels/voltage_v"] >= 300
    controller = folder_option("single", tmp_path)
    out = tmp_path / "evaluation"
    shortest = ["--seconds", "3", "--repeats", "1", "--set", "references=[[1.0,-1.0]]"]
    main(["evaluate", str(controller), *plant, "--out", str(out), *shortest])
    assert (out / "evaluation.json").exists()
    main(["rig", "stop", *options])


def test_a_new_zero_voids_the_proof_of_the_servos_own_stop(rig, capsys):
    options = ["--rig", str(rig)]
    main(["rig", "zero", *options, "--angle", "--arm", "--yes"])
    main(["rig", "check", *options, "--prove", "--arm", "--yes"])
    move = ["collect", "--plant", f"rig:{rig}", "--arm", "--yes", "--out", str(rig.parent / "data")]
    servo = rigs[rig.resolve()].drive
    servo.set(protocol.HOMING_OFFSET, 200)
    line, code = fails(capsys, *move)
    assert (
        f"no longer valid (homing_offset was {-MOUNTED_TICKS} and is 200); run: softfin rig check"
        in line
    )
    assert code == 2
    assert not servo.get(protocol.TORQUE_ENABLE)
    main(["rig", "check", *options, "--json"])
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["own stop"]["state"] == "note"
