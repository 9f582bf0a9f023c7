import json

import pytest

from softfin.cli import main
from softfin.storage.log_file import read_log
from tests.data.recorded import record


def softfin(*words) -> int:
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture
def cut(tmp_path):
    path = record(tmp_path / "run.mcap", rows=400)
    path.write_bytes(path.read_bytes()[:100_000])
    return path


def test_a_recording_that_was_cut_off_is_recovered_then_converted(cut, tmp_path, capsys):
    assert softfin("bag", "convert", cut, "--out", tmp_path / "run.parquet") == 2
    assert f"softfin bag recover {cut}" in capsys.readouterr().err
    assert softfin("bag", "recover", cut) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"{tmp_path / 'run.recovered.mcap'}: ")
    assert "recovered; " in text
    assert (
        softfin(
            "bag", "convert", tmp_path / "run.recovered.mcap", "--out", tmp_path / "run.parquet"
        )
        == 0
    )
    rows = len(read_log(tmp_path / "run.parquet").reading.time)
    assert f"{rows} rows" in capsys.readouterr().out
    assert rows > 200


def test_what_came_of_it_is_told_as_json(cut, tmp_path, capsys):
    assert softfin("bag", "recover", cut, "--out", tmp_path / "saved.mcap", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["recovered"] == str(tmp_path / "saved.mcap")
    assert result["messages"]["/fin/joint_states"] > 200
    assert result["damages"][0]["reason"] == "incomplete record"
    assert softfin("bag", "recover", tmp_path / "saved.mcap", "--json") == 0
    assert json.loads(capsys.readouterr().out)["recovered"] is None
    assert softfin("bag", "recover", tmp_path / "saved.mcap") == 0
    assert "not damaged" in capsys.readouterr().out
    assert not (tmp_path / "saved.recovered.mcap").exists()
