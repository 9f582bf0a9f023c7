"""A whole day at an emulated rig with a Dynamixel and a force sensor that sends lines."""

import json

import pyarrow.parquet as pq
import pytest
import yaml

from softfin.cli import main
from softfin.core.errors import RigError
from softfin.rig.config import load_rig
from softfin.rig.emulation.rig import rigs
from softfin.rig.prove import check_proof
from softfin.rig.record import load_record
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
    main(["rig", "check", *options, "--prove", "--arm", "--yes"])
    proof = load_record(rig).stop_proof
    assert 0.1 <= proof.faulted_after_s <= 0.15
    for changed in ({"id": 9}, {"model": "XH430-V350"}):
        rig.write_text(yaml.safe_dump(values | {"drive": values["drive"] | changed}))
        with pytest.raises(RigError, match="no proof yet that its drive stops"):
            check_proof(load_rig(rig), None)
    rig.write_text(yaml.safe_dump(values))
    assert check_proof(load_rig(rig), None) == proof
    main(["rig", "zero", *options, "--arm", "--yes"])
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
