import pytest

from softfin.stages.surrogates import calibration_tables
from tests.cli.test_cli import fails


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tank", "--velocity-rad-s", "[3, 2]"], "velocity_rad_s = 3, 2: the plant accepts"),
        (
            ["tank", "--parameters.fin.lenght-m", "[0.1, 0.3]"],
            "unknown parameter 'fin.lenght_m'; did you mean 'fin.length_m'?",
        ),
        (
            ["tank", "--parameters.fin.length-m=3"],
            "parameters.fin.length_m = 3: must be a list",
        ),
        (
            ["tank", "--evaluations", "-1"],
            "evaluations = -1: Input should be greater than or equal to 0",
        ),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch, words, expected):
    monkeypatch.chdir(tmp_path)
    line, code = fails(capsys, "calibrate", *words, "--out", "x")
    assert expected in line
    assert code == 2
    assert list(tmp_path.iterdir()) == []


RESULT = {
    "scores": {
        part: {channel: {"r2": 0.9, "rmse": 0.12} for channel in ("angle", "force_x", "force_y")}
        for part in ("train", "test")
    },
    "parameters": {
        "fin.length_m": {
            "value": 0.2,
            "standard_error": 0.013,
            "unit": "m",
            "determined": "roughly",
        },
        "drive.lag_s": {
            "value": 0.003,
            "standard_error": None,
            "unit": "s",
            "determined": "low end",
        },
    },
}


def test_errors_of_a_small_fin_have_two_digits():
    scores = {channel: {"r2": 0.9, "rmse": 0.0034} for channel in ("angle", "force_x", "force_y")}
    text = calibration_tables(RESULT | {"scores": {"train": scores, "test": scores}})
    assert "0.900 (0.0034 N)" in text


def test_the_table_says_what_is_determined_and_what_is_at_an_end():
    text = calibration_tables(RESULT)
    assert "unseen segments  0.900 (0.12 rad)  0.900 (0.12 N)  0.900 (0.12 N)" in text
    assert "fin.length_m    0.2  0.013  m        roughly" in text
    assert "drive.lag_s   0.003         s        low end" in text
