import contextlib
import json
import signal
import time

import pytest

from softfin.cli import main
from softfin.rig.cia402 import State
from softfin.rig.emulation.rig import EmulatedRig
from softfin.rig.emulation.simple import SimpleFin
from tests.cli.terminal import Terminal
from tests.cli.test_cli import fails
from tests.rig.rigs import patient, write_wide


@pytest.fixture
def emulated():
    with patient(), EmulatedRig(fin=SimpleFin()) as behind:
        yield behind


@pytest.fixture
def file(emulated, tmp_path):
    return str(write_wide(emulated, tmp_path / "rig.yaml"))


def found(capsys):
    return {row["what"]: row for row in json.loads(capsys.readouterr().out)}


def test_a_rig_is_checked_without_moving(file, emulated, capsys):
    # A busy machine's loop is late, and the table says so.
    with contextlib.suppress(SystemExit):
        main(["rig", "check", "--rig", file, "--json"])
    rows = found(capsys)
    assert list(rows) == ["rig file", "disk", "force sensor", "force at rest", "drive", "angle", "zero", "100 Hz loop",
                          "readings"]  # fmt: skip
    for what in ("rig file", "force sensor", "force at rest", "drive", "angle", "zero"):
        assert rows[what]["state"] == "well", rows[what]
    assert emulated.fin.now().angle == 0.0
    assert emulated.drive.state is State.SWITCH_ON_DISABLED


def test_what_is_wrong_is_in_the_table_and_the_exit_code(file, emulated, capsys):
    emulated.drive.fault(0x2310)
    emulated.sensor.status(0x88000000)
    with pytest.raises(SystemExit) as ended:
        main(["rig", "check", "--rig", file])
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert "WRONG  drive " in said.out
    assert "0x2310, over-current" in said.out
    assert "WRONG  sensor status " in said.out
    assert "not well: sensor status, drive" in said.err


def test_a_fault_is_named_and_reset_when_asked(file, emulated, capsys):
    emulated.drive.fault(0x8611)
    with pytest.raises(SystemExit):
        main(["rig", "check", "--rig", file, "--json"])
    assert found(capsys)["drive"]["state"] == "wrong"
    with contextlib.suppress(SystemExit):
        main(["rig", "check", "--rig", file, "--json", "--reset-fault"])
    said = capsys.readouterr()
    assert "reset: drive fault 0x8611, following error" in said.err
    assert '"what": "drive",\n    "state": "well"' in said.out


def test_zeroing_the_angle_needs_arm_and_moves_nothing(file, emulated, capsys):
    line, code = fails(capsys, "rig", "zero", "--rig", file, "--angle")
    assert (line.endswith("nothing moves without --arm"), code) == (True, 2)
    # The drive that the refused command let go of may still come to rest, and its fin with it.
    while emulated.fin.now().angle != 0.2:
        emulated.fin.move(0.2, 10.0)
        time.sleep(0.05)
    main(["rig", "zero", "--rig", file, "--arm", "--yes", "--angle", "--json"])
    told = json.loads(capsys.readouterr().out)
    assert abs(told["angle_after_rad"]) < 1e-3
    assert emulated.fin.now().angle == pytest.approx(0.2)


def test_zeroing_the_force_needs_no_arm(file, capsys):
    main(["rig", "zero", "--rig", file, "--force", "--json"])
    assert set(json.loads(capsys.readouterr().out)) == {"force_before_n", "force_after_n", "noise_n"}


def test_a_file_that_is_not_there_says_where_to_find_one(tmp_path, capsys):
    line, code = fails(capsys, "rig", "check", "--rig", str(tmp_path / "no.yaml"))
    assert "no.yaml: no such file; docs/rig.md has one" in line
    assert code == 2


def test_an_emulated_rig_runs_until_ctrl_c_and_never_overwrites_a_file(tmp_path):
    with Terminal(["rig", "emulate"], tmp_path) as terminal:
        terminal.wait_for("pages at http://127.0.0.1:")
        assert "interface: socketcand" in (tmp_path / "rig.yaml").read_text()
        terminal.signal(signal.SIGINT)
        assert terminal.ended() == 0
        assert "Traceback" not in terminal.said
    with Terminal(["rig", "emulate"], tmp_path) as terminal:
        assert terminal.ended() == 2
        assert "rig.yaml: exists; give another --rig, or --overwrite" in terminal.said
