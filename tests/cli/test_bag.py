import json

import pytest

from softfin.cli import main
from tests.data.recorded import record


def softfin(*words) -> int:
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture
def cut(tmp_path):
    path = record(tmp_path / "run.mcap", rows=4000)
    path.write_bytes(path.read_bytes()[:1_500_000])
    return path


def test_a_recording_that_was_cut_off_is_recovered_then_imported(cut, tmp_path, capsys):
    assert softfin("inspect", cut) == 2
    assert f"softfin bag recover {cut}" in capsys.readouterr().err
    assert softfin("bag", "recover", cut) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"{tmp_path / 'run.recovered.mcap'}: ")
    assert "recovered; damaged at byte " in text
    assert softfin("inspect", tmp_path / "run.recovered.mcap") == 0


def test_the_result_as_json(cut, tmp_path, capsys):
    assert softfin("bag", "recover", cut, "--out", tmp_path / "saved.mcap", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["recovered"] == str(tmp_path / "saved.mcap")
    assert result["messages"]["/fin/joint_states"] > 1000
    assert result["damages"][0]["reason"] == "incomplete record"
    assert softfin("bag", "recover", tmp_path / "saved.mcap") == 0
    assert "not damaged" in capsys.readouterr().out
