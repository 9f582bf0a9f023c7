import pytest

from softfin.cli import main
from softfin.storage.dataset import Dataset
from tests.cli.test_cli import fails

FIN = "tests.plants:AnalyticFin"


def test_a_dataset_names_its_plant_and_its_excitation(tmp_path):
    out = tmp_path / "random"
    main(
        [
            "collect",
            "--plant",
            FIN,
            "--out",
            str(out),
            "--logs",
            "2",
            "--test-logs",
            "1",
            "--rows",
            "300",
        ]
    )
    data = Dataset.open(out)
    assert data.description["commands"] == {"excitation": "random"}
    assert data.description["plant_identity"].startswith("tests.plants.AnalyticFin ")


@pytest.mark.parametrize("option", ["--arm", "--resume"])
def test_options_of_a_real_fin_are_refused_for_a_simulated_one(tmp_path, capsys, option):
    line, code = fails(capsys, "collect", "--plant", FIN, "--out", str(tmp_path / "new"), option)
    assert f"{option}: {FIN} is simulated; omit {option}, or use --plant rig" in line
    assert code == 2
    assert not (tmp_path / "new").exists()
