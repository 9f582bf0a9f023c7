import pytest

from softfin.cli import main
from softfin.rig.device import CheckResult
from softfin.stages import doctor


def test_what_is_wrong_is_a_line_and_the_exit_code(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_can", lambda: CheckResult("CAN", "wrong", "broken"))
    with pytest.raises(SystemExit) as ended:
        main(["doctor"])
    said = capsys.readouterr()
    assert ended.value.code == 1
    assert " WRONG  CAN            broken\n" in said.out
    assert said.err == "softfin doctor: failed: CAN\n"
