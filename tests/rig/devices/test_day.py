"""A whole day at emulated rigs with each drive and each kind of force sensor, by the commands."""

import contextlib
import json

import pyarrow.parquet as pq
import pytest
import yaml

from softfin.cli import main
from softfin.emulation.dynamixel import MOUNTED_TICKS
from softfin.emulation.rig import rigs
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.record import load_record
from tests import needs
from tests.cli.test_cli import fails
from tests.control.folders import folder_option
from tests.rig.bags import counts_of
from tests.rig.rigs import emulated_by_command, over_sockets


@pytest.fixture
def sensor_rig(tmp_path):
    """An EPOS2, and a force sensor that sends lines."""
    with emulated_by_command(tmp_path / "rig.yaml", "--sensor", "lines") as file:
        yield file


@pytest.fixture
def servo_rig(tmp_path):
    options = ("--drive", "dynamixel", "--sensor", "lines")
    with emulated_by_command(tmp_path / "rig.yaml", *options) as file:
        yield file


@pytest.fixture
def serial_rig(tmp_path):
    """In real time: the sensor is on a pseudo-terminal, and the proof was given before."""
    needs.module("serial", "pyserial is not installed")
    with over_sockets(tmp_path / "rig.yaml", sensor="lines"):
        yield tmp_path / "rig.yaml"


def armed(rig, *words):
    main([*words, "--rig", str(rig), "--arm", "--yes"])


def checked(rig, capsys):
    """What a check without motion tells; all is well but perhaps this computer, which may be busy."""
    capsys.readouterr()
    # The exit status says whether all is well, this computer included.
    with contextlib.suppress(SystemExit):
        main(["rig", "check", "--rig", str(rig), "--json"])
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    of_the_rig = {row["state"] for what, row in rows.items() if what != "100 Hz loop"}
    assert of_the_rig <= {"well", "note"}
    return rows


def pass_a_day(rig, capsys):
    """Zero, check, collect and evaluate; returns the rows of the check and the dataset's
    description."""
    values = yaml.safe_load(rig.read_text())
    armed(rig, "rig", "zero")
    zero = load_record(rig).force_zero
    rows = checked(rig, capsys)
    plant = ["--plant", f"rig:{rig}", "--arm", "--yes"]
    data = rig.with_name("data")
    counts = ["--logs", "1", "--test-logs", "1", "--rows", "300"]
    main(["collect", *plant, "--out", str(data), *counts])
    described = json.loads((data / "dataset.json").read_text())
    for part in ("drive", "sensor"):
        assert described["rig"][part]["type"] == values[part].get("type", "epos2")
    measured = described["sensor_by_log"]["train-0000"]
    assert measured["force_delay_s"] > 0.01
    assert measured["force_zero"]["wrench"] == list(zero.wrench)
    controller = folder_option("single", rig.parent)
    out = rig.with_name("evaluation")
    shortest = ["--seconds", "3", "--repeats", "1", "--reference=1,-1"]
    main(["evaluate", str(controller), *plant, "--out", str(out), *shortest])
    assert (out / "evaluation.json").exists()
    return rows


def test_a_day_passes_with_a_sensor_that_sends_lines(sensor_rig, capsys):
    armed(sensor_rig, "rig", "check", "--prove")
    rows = pass_a_day(sensor_rig, capsys)
    assert rows["force sensor"]["text"].startswith("lines, 320/s, delay ")


@pytest.mark.real_time
def test_a_day_passes_over_a_pseudo_terminal(serial_rig, capsys):
    assert yaml.safe_load(serial_rig.read_text())["sensor"]["port"].startswith("/dev/pts/")
    rows = pass_a_day(serial_rig, capsys)
    assert rows["force sensor"]["text"].startswith("lines, ")


def test_a_day_passes_with_a_servo_that_keeps_its_zero(servo_rig, capsys):
    # Zeroing does not power the motor, so it needs no proof, but the proof depends on the zero.
    armed(servo_rig, "rig", "zero")
    assert "stop of the drive: rig of emulated: no proof yet" in capsys.readouterr().out
    armed(servo_rig, "rig", "check", "--prove")
    proof = load_record(servo_rig).stop_proof
    assert 0.1 <= proof.faulted_after_s <= 0.15
    assert proof.drive["firmware"] == 48
    assert proof.drive["homing_offset"] == -MOUNTED_TICKS
    # The next command starts from the state file.
    rigs.pop(servo_rig.resolve()).close()
    rows = checked(servo_rig, capsys)
    assert rows["drive"]["text"].startswith("XM430-W350, simulated, ID 1: limits read, supply 12")
    assert rows["zero"]["text"] == "known"
    assert rows["own stop"]["state"] == "well"
    assert rows["own stop"]["text"].startswith("drive stopped 100 ms after")
    pass_a_day(servo_rig, capsys)
    log = pq.read_table(servo_rig.with_name("data") / "train" / "0000.parquet")
    assert log["voltage_v"].to_numpy() == pytest.approx(12.0)
    bag = servo_rig.with_name("data-bags") / "train-0000.mcap"
    assert counts_of(bag)["/fin/channels/voltage_v"] >= 300
    main(["rig", "stop", "--rig", str(servo_rig)])


def test_a_new_zero_voids_the_proof_of_the_servos_own_stop(servo_rig, capsys):
    armed(servo_rig, "rig", "zero", "--angle")
    armed(servo_rig, "rig", "check", "--prove")
    servo = rigs[servo_rig.resolve()].drive
    servo.set(protocol.HOMING_OFFSET, 200)
    move = ["collect", "--plant", f"rig:{servo_rig}", "--arm", "--yes"]
    line, code = fails(capsys, *move, "--out", str(servo_rig.with_name("data")))
    assert (
        f"no longer valid (homing_offset was {-MOUNTED_TICKS} and is 200); run: softfin rig check"
        in line
    )
    assert code == 2
    assert not servo.get(protocol.TORQUE_ENABLE)
    assert checked(servo_rig, capsys)["own stop"]["state"] == "note"
