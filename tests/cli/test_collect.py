import json
from pathlib import Path

import numpy as np
import pytest

from softfin.cli import main
from softfin.data.collect import CollectConfig
from softfin.stages.collect import collect
from softfin.storage.dataset import Dataset
from softfin.surrogate import save_surrogate
from tests.cli.test_cli import fails
from tests.surrogate import small
from tests.surrogate.test_active import streaming

FIN = "tests.plants:AnalyticFin"
ACTIVE = ["--excitation", "active"]
FEW = ["--set", "active.candidates=4", "--set", "active.piece_s=1"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("collect")
    save_surrogate(root / "ensemble", streaming(), None, {"data_hash": "d"})
    save_surrogate(root / "paper", small.surrogate(), None, {})
    collect(FIN, root / "random", CollectConfig(logs=2, test_logs=1, rows=300))
    return root


def collected(folders, out, *words):
    main(["collect", "--plant", FIN, "--out", str(out), *(str(word) for word in words)])
    return Dataset.open(out)


def test_a_dataset_is_recorded_on_under_commands_that_an_ensemble_chooses(folders, tmp_path, capsys):
    words = [*ACTIVE, "--surrogate", folders / "ensemble", "--extend", folders / "random", *FEW]
    data = collected(folders, tmp_path / "d", *words, "--logs", 1, "--rows", 400, "--json")
    said = json.loads(capsys.readouterr().out)
    assert (said["logs"], said["test_logs"]) == (3, 1)
    assert said["data_hash"] == data.data_hash
    new, *old = data.load(data.train)
    assert len(new.reading.time) == 400
    before = Dataset.open(folders / "random")
    for one, another in zip(old, before.load(before.train), strict=True):
        np.testing.assert_array_equal(one.reading.force, another.reading.force)
    told = data.description["commands"]
    assert told == {"excitation": "active", "surrogate": str(folders / "ensemble"), "members": 2, "data_hash": "d"}
    assert data.description["configuration"]["active"]["candidates"] == 4
    assert data.description["extends"]["description"]["commands"] == {"excitation": "random"}


def test_random_excitation_is_the_default_and_says_so(folders):
    data = Dataset.open(folders / "random")
    assert data.description["commands"] == {"excitation": "random"}
    assert data.description["plant_identity"].startswith("tests.plants.AnalyticFin ")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (ACTIVE, "active excitation needs an ensemble to choose the commands: give --surrogate DIR"),
        (["--surrogate", "ensemble"], "surrogate ensemble: random excitation asks none; --excitation active does"),
        ([*ACTIVE, "--surrogate", "paper"], "paper: a paper surrogate; active excitation needs members that can"),
        ([*ACTIVE, "--surrogate", "random"], "random: not a surrogate: it holds no surrogate.json"),
        (
            ["--extend", "random", "--plant", "tank"],
            f"random: recorded of {FIN}, not of tank as it is now; logs of two",
        ),
        (["--set", "active.candidates=4"], "unknown key 'active'"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_nothing(folders, monkeypatch, capsys, words, expected):
    # The plant is looked for where one works.
    monkeypatch.syspath_prepend(str(Path.cwd()))
    monkeypatch.chdir(folders)
    line, code = fails(capsys, "collect", "--plant", FIN, "--out", "new", *words)
    assert expected in line
    assert code == 2
    assert not (folders / "new").exists()
