import json
import re
import signal
from pathlib import Path

import pytest

import softfin
from softfin.cli import main
from softfin.core.errors import RunError
from softfin.emulation.epos2.drive import DriveTraits
from softfin.rig.config import load_rig
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.machine import Target
from softfin.rig.safety import SafetyConfig
from tests.cli.terminal import Terminal
from tests.cli.test_cli import fails
from tests.rig.rigs import filed, simulated


@pytest.fixture
def emulated():
    with simulated() as behind:
        yield behind


@pytest.fixture
def file(emulated, tmp_path):
    with filed(emulated, tmp_path / "rig.yaml") as written:
        yield str(written)


def found(capsys):
    return {row["what"]: row for row in json.loads(capsys.readouterr().out)}


def test_a_rig_is_checked_without_moving(file, emulated, capsys):
    main(["rig", "check", "--rig", file, "--json"])
    rows = found(capsys)
    # The simple fin of the tests is given limits of the current that its drive never reaches.
    drive_rows = ["drive", "safety", "own stop", "stop in motion", "angle", "zero"]
    sensor_rows = ["force sensor", "force at rest", "force zero"]
    assert list(rows) == ["rig file", "disk", *drive_rows, *sensor_rows, "100 Hz loop", "readings"]
    for what in ("rig file", "force sensor", "force at rest", "drive", "own stop", "angle", "zero"):
        assert rows[what]["state"] == "well", rows[what]
    assert rows["100 Hz loop"]["state"] == "note"
    assert "nothing is late in simulated time" in rows["100 Hz loop"]["text"]
    assert emulated.fin.now().angle == 0.0
    assert emulated.drive.state is State.SWITCH_ON_DISABLED


def test_what_is_wrong_is_in_the_table_and_the_exit_code(file, emulated, capsys):
    emulated.drive.fault(0x2310)
    emulated.sensor.status = 0x88000000
    with pytest.raises(SystemExit) as ended:
        main(["rig", "check", "--rig", file])
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert "WRONG  drive " in said.out
    assert "0x2310, over-current" in said.out
    assert "WRONG  force sensor " in said.out
    assert "failed: drive, force sensor" in said.err


def test_a_fault_is_named_and_reset_when_asked(file, emulated, capsys):
    emulated.drive.fault(0x8611)
    with pytest.raises(SystemExit):
        main(["rig", "check", "--rig", file, "--json"])
    assert found(capsys)["drive"]["state"] == "wrong"
    main(["rig", "check", "--rig", file, "--json", "--reset-fault"])
    said = capsys.readouterr()
    assert "reset: drive fault 0x8611, following error" in said.err
    assert '"what": "drive",\n    "state": "well"' in said.out


def test_zeroing_the_angle_needs_arm_and_moves_nothing(file, emulated, capsys):
    line, code = fails(capsys, "rig", "zero", "--rig", file, "--angle")
    assert (line.endswith("nothing moves without --arm"), code) == (True, 2)
    emulated.fin.move(0.2, 10.0)
    main(["rig", "zero", "--rig", file, "--arm", "--yes", "--angle", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert abs(told["angle_after_rad"]) < 1e-3
    assert emulated.fin.now().angle == pytest.approx(0.2)


def test_nothing_moves_before_it_is_proved_that_the_drive_stops_by_itself(file, emulated, capsys):
    record = Path(file).with_suffix(".record.json")
    record.unlink()
    zero = ("rig", "zero", "--rig", file, "--angle", "--arm", "--yes")
    line, code = fails(capsys, *zero)
    assert "no proof yet that its drive stops if softfin dies" in line
    assert line.endswith(f"run: softfin rig check --rig {Path(file).resolve()} --prove --arm")
    assert code == 2
    assert emulated.drive.state is State.SWITCH_ON_DISABLED
    line, code = fails(capsys, "rig", "check", "--rig", file, "--prove")
    assert (line.endswith("nothing moves without --arm"), code) == (True, 2)
    main(["rig", "check", "--rig", file, "--prove", "--arm", "--yes", "--json"])
    proof = json.loads(capsys.readouterr().out)
    assert 0.2 <= proof["faulted_after_s"] <= 0.25
    assert json.loads(record.read_text())["stop_proof"] == proof
    assert emulated.fin.now().angle == 0.0
    main(list(zero))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"drive": {"type": "epos2", "node": 1, "serial": 1}}, "serial was 1 and is "),
        ({"drive": {"type": "epos2", "node": 1, "serial": None}}, "serial was None and is "),
        ({"drive": {"type": "other"}}, "type was 'other' and is 'epos2'"),
        ({"heartbeat_s": 0.3}, "heartbeat_s was 0.3 and is 0.2"),
        ({"host_node": 99}, "host_node was 99 and is 126"),
    ],
)
def test_a_proof_for_a_different_drive_or_settings_is_not_valid(file, capsys, change, words):
    record = Path(file).with_suffix(".record.json")
    proof = json.loads(record.read_text())["stop_proof"]
    record.write_text(json.dumps({"stop_proof": proof | change}))
    line, _ = fails(capsys, "rig", "zero", "--rig", file, "--angle", "--arm", "--yes")
    assert "the proof that its drive stops is no longer valid (" in line
    assert words in line
    main(["rig", "check", "--rig", file, "--json"])
    assert found(capsys)["own stop"]["state"] == "note"


def test_a_drive_that_ignores_the_loss_of_the_heartbeats_loses_its_proof(file, emulated, capsys):
    emulated.drive._traits = DriveTraits(ignores_heartbeat=True)
    line, code = fails(capsys, "rig", "check", "--rig", file, "--prove", "--arm", "--yes")
    assert "drive ignores missing heartbeats from softfin" in line
    assert code == 1
    assert json.loads(Path(file).with_suffix(".record.json").read_text())["stop_proof"] is None
    assert emulated.drive.state is State.SWITCH_ON_DISABLED


def test_a_proof_that_failed_and_cannot_be_removed_is_told_after_the_drives_own_line(
    file, emulated, capsys, monkeypatch
):
    def full_disk(*_):
        raise RunError("rig.record.json: cannot be written (No space left on device)")

    monkeypatch.setattr("softfin.rig.prove.save_record", full_disk)
    emulated.drive._traits = DriveTraits(ignores_heartbeat=True)
    line, _ = fails(capsys, "rig", "check", "--rig", file, "--prove", "--arm", "--yes")
    assert "drive ignores missing heartbeats from softfin" in line
    assert line.endswith(
        "could not be removed: rig.record.json: cannot be written (No space left on device)"
    )


def test_a_drive_that_was_left_powered_is_stopped_by_a_command_without_arm(file, emulated, capsys):
    emulated.drive._traits = DriveTraits(ignores_heartbeat=True)
    config = load_rig(Path(file))
    left = Epos2(config.bus, config.drive, emulated.clock)
    left.open()
    left.enable()
    left.command(Target(1.5, 1.0))
    emulated.clock.sleep(0.5)
    # As if its program had been killed.
    left.connection.close()
    assert emulated.drive.state is State.OPERATION_ENABLED
    assert emulated.fin.now().velocity > 0
    main(["rig", "stop", "--rig", file, "--json"])
    assert json.loads(capsys.readouterr().out) == {"motor": "off"}
    assert emulated.drive.state is State.SWITCH_ON_DISABLED
    assert emulated.fin.now().velocity == 0.0
    emulated.drive.go_silent()
    line, code = fails(capsys, "rig", "stop", "--rig", file)
    assert "press the emergency stop" in line
    assert code == 1


def test_zeroing_the_force_needs_no_arm(file, capsys):
    main(["rig", "zero", "--rig", file, "--force", "--json"])
    assert set(json.loads(capsys.readouterr().out)) == {
        "force_before_n",
        "force_after_n",
        "noise_n",
    }
    main(["rig", "zero", "--rig", file, "--arm", "--yes"])
    text = capsys.readouterr().out
    assert text.startswith("angle before: ")
    assert "force at rest now: " in text
    assert "_" not in text
    assert "-0.000" not in text


@pytest.mark.real_time
def test_an_emulated_rig_in_real_time_runs_until_ctrl_c(tmp_path):
    with Terminal(["rig", "emulate", "--real-time"], tmp_path) as terminal:
        terminal.wait_for("http_port ")
        assert "interface: socketcand" in (tmp_path / "rig.yaml").read_text()
        terminal.signal(signal.SIGINT)
        assert terminal.ended() == 0
        assert "Traceback" not in terminal.said


def test_every_message_that_suggests_to_zero_the_fin_gives_a_command_that_is_not_refused():
    """Without --arm, only --force is zeroed."""
    suggested = []
    for file in Path(softfin.__file__).parent.rglob("*.py"):
        # A message may be cut into pieces over several lines.
        suggested += re.findall(r"softfin rig zero.{,60}", file.read_text(), re.DOTALL)
    assert len(suggested) >= 5
    for text in suggested:
        assert "--arm" in text or "--force" in text, text


def test_an_emulated_rig_is_a_file_that_says_so_and_never_overwrites_one(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    main(["rig", "emulate", "--seed", "3"])
    told = capsys.readouterr().out
    assert (
        "Next: softfin rig check --prove --arm, then softfin rig zero --arm, then softfin collect "
        "--plant rig --arm" in told
    )
    config = load_rig(tmp_path / "rig.yaml")
    assert config.emulation.seed == 3
    assert config.drive.heartbeat_s == 0.2
    assert config.safety == SafetyConfig(current_peak_a=3.0, current_sustained_a=1.5)
    line, code = fails(capsys, "rig", "emulate")
    assert (
        line.endswith("already exists; set a different --rig, or use --overwrite to replace it"),
        code,
    ) == (True, 2)
    (tmp_path / "rig.state.json").write_text("of the rig before")
    main(["rig", "emulate", "--overwrite"])
    assert not (tmp_path / "rig.state.json").exists()
    assert load_rig(tmp_path / "rig.yaml").emulation.seed == 0


def test_an_interrupted_stop_is_not_reported_as_done(file, capsys, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("softfin.rig.devices.epos2.drive.Epos2.switch_off", interrupt)
    line, code = fails(capsys, "rig", "stop", "--rig", file)
    assert "did not confirm that its motor is off; press the emergency stop" in line
    assert code == 1
