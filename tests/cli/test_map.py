import json

import pytest

from softfin.cli import main
from softfin.core.errors import PlantError
from tests.cli.test_cli import fails

QUICK = (
    "--survey.cycles=2",
    "--survey.batch=256",
    "--survey.directions=8",
    "--survey.pushes=1",
    "--spacing-n=0.5",
    "--gaits.cycles=2",
    "--gaits.steps=6",
    "--box={low: [0.5, -0.5], high: [1.5, 0.5]}",
)


def test_a_map_is_a_folder_and_a_summary(capsys, tmp_path):
    main(["map", "tests.plants:StrokeFin", *QUICK, "--out", str(tmp_path / "x"), "--json"])
    summary = json.loads(capsys.readouterr().out)
    assert summary["nodes"] == 25
    assert summary["held"] >= 8
    assert summary["area_n2"] > 2
    assert (tmp_path / "x" / "map.png").is_file()
    assert (
        json.loads((tmp_path / "x" / "controller.json").read_text())["configuration"]["gaits"][
            "steps"
        ]
        == 6
    )


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["tank", "--spacing-n", "0"], "spacing_n = 0: Input should be greater than 0"),
        (["tank", "--survey.direction", "8"], "did you mean 'directions'?"),
        (
            ["tank", "--clock", "auto"],
            "--clock auto: the stroke time of tank is unknown; use a rate",
        ),
        (["tank", "--clock", "6;1"], "--clock 6;1: must be paper, auto, a rate in Hz such as 6"),
        (["tank", "--box", "{low: [1, 0], high: [0, 1]}"], "must not be greater than high"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(capsys, tmp_path, words, expected):
    line, code = fails(capsys, "map", *words, "--out", str(tmp_path / "x"))
    assert expected in line
    assert code == 2
    assert not (tmp_path / "x").exists()


def test_a_clock_that_is_asked_for_wins_over_the_file(capsys, tmp_path, monkeypatch):
    (tmp_path / "map.yaml").write_text("clock: {ticks: [25], window_actions: 8}\nnodes: 9\n")
    asked = []

    def find(plant, config, report):
        asked.append(config)
        raise PlantError("enough")

    monkeypatch.setattr("softfin.gaits.force_map.find_force_map", find)
    words = ("tests.plants:StrokeFin", "--config", str(tmp_path / "map.yaml"))
    fails(capsys, "map", *words, "--out", str(tmp_path / "x"))
    fails(capsys, "map", *words, "--clock", "6,1", "--nodes", "8", "--out", str(tmp_path / "x"))
    assert [config.clock.rate_hz for config in asked] == [4, 6]
    assert [config.nodes for config in asked] == [9, 8]
