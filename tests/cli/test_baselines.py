import json

import pytest

from softfin.cli import main
from softfin.cli.evaluation import baselines_table
from tests.cli.test_cli import fails

QUICK = (
    "--plant",
    "tests.plants:AnalyticFin",
    "--seconds",
    "3",
    "--repeats",
    "2",
    "--set",
    "search.seconds=3",
)
FEW = (
    "search.centres=3",
    "search.amplitudes=2",
    "search.frequencies_hz=[1]",
    "search.refinements=0",
)


def test_baselines_are_a_table_and_a_json(capsys, tmp_path):
    small = [
        word
        for change in (*FEW, "search.gaits=4", "references=[[1,-1]]")
        for word in ("--set", change)
    ]
    main(["baselines", *QUICK, *small, "--out", str(tmp_path / "x"), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((tmp_path / "x" / "baselines.json").read_text())
    assert {"still", "sine", "inverse_2.1_hz", "recalibrated_1.1_hz", "random_search"} < set(
        result["baselines"]
    )
    assert result["plant"] == result["searched_in"] == "tests.plants:AnalyticFin"
    assert result["configuration"]["search"]["gaits"] == 4
    lines = baselines_table(result["baselines"], {"recurrent_ppo": "no sb3"}).splitlines()
    assert "Table II, still" in lines[0]
    means = lines[lines.index("") + 2 :]
    assert [line.split()[0] for line in means] == [*result["baselines"], "recurrent_ppo"]
    clipped = next(line for line in means if line.startswith("inverse_1.1_hz"))
    assert clipped.endswith("1 of 1 clipped by the limits")
    assert means[-1].endswith("left out: no sb3")
    small = result["baselines"]["still"]
    small["references"][0]["reference_n"] = [0.2, -0.1]
    last = baselines_table({"still": small}, {}).splitlines()[-1]
    assert last.split()[1] == f"{small['mean']['x']['error_n']:.4f}"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--seconds", "2"], "seconds = 2: Input should be greater than or equal to 3"),
        (["--set", "search.gait=3"], "did you mean 'gaits'?"),
        (["--set", "inverse.area_m2=0"], "inverse.area_m2 = 0: Input should be greater than 0"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(capsys, tmp_path, words, expected):
    line, code = fails(capsys, "baselines", *words, "--out", str(tmp_path / "x"))
    assert expected in line
    assert code == 2
    assert not (tmp_path / "x").exists()
