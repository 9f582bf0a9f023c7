import json

import pytest

from softfin.cli import main
from softfin.rig import doctor
from softfin.rig.device import CheckResult
from tests.rig.rigs import filed, simulated


def test_the_rig_of_a_file_is_examined_too(tmp_path, capsys):
    with simulated() as behind, filed(behind, tmp_path / "rig.yaml") as file:
        main(["doctor", "--rig", str(file), "--json"])
    rows = json.loads(capsys.readouterr().out)
    assert [row["what"] for row in rows][-3:] == ["force zero", "100 Hz loop", "readings"]
    assert {row["state"] for row in rows} <= {"well", "note"}


def test_what_is_wrong_is_a_line_and_the_exit_code(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_can", lambda: CheckResult("CAN", "wrong", "broken"))
    with pytest.raises(SystemExit) as ended:
        main(["doctor"])
    said = capsys.readouterr()
    assert ended.value.code == 1
    assert " WRONG  CAN            broken\n" in said.out
    assert said.err == "softfin doctor: failed: CAN\n"


def test_a_file_that_is_not_there_is_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["doctor", "--rig", str(tmp_path / "no.yaml")])
    assert ended.value.code == 2
    assert "no.yaml: cannot be read" in capsys.readouterr().err
