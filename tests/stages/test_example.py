"""The example of the package is what it says, loads, and holds forces in the tank."""

import hashlib
import json
import runpy
import subprocess
import tomllib
from pathlib import Path

import pytest

import softfin
from softfin.cli import main
from softfin.core.plant_identity import identity
from softfin.core.quantities import RATE_HZ
from softfin.stages.example import EXAMPLE
from softfin.storage import artifact as artifacts
from tests.documents import ROOT

DESCRIPTION = json.loads((EXAMPLE / "example.json").read_text())
CONTROLLERS = sorted(file.parent.name for file in EXAMPLE.glob("*/controller.json"))
LARGEST_BYTES = 1_500_000


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> Path:
    """As a user has it."""
    out = tmp_path_factory.mktemp("user") / "example"
    main(["example", str(out)])
    return out


def test_the_copy_holds_every_file_as_the_description_lists_it(example):
    written = {
        file.relative_to(example).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in example.rglob("*")
        if file.is_file()
    }
    assert written.keys() - DESCRIPTION["files"].keys() == {"example.json", "README.md"}
    assert written.items() >= DESCRIPTION["files"].items()
    assert sum(file.stat().st_size for file in example.rglob("*")) <= LARGEST_BYTES


def test_its_readme_states_the_figures_of_its_description():
    script = runpy.run_path(str(ROOT / "examples/make_example.py"))
    assert (EXAMPLE / "README.md").read_text() == script["readme"](DESCRIPTION)


def test_it_is_written_once_and_replaced_only_on_request(example, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["example", str(example)])
    assert stop.value.code == 2
    assert (
        "already exists; choose a different folder, or use --overwrite to replace it"
        in capsys.readouterr().err
    )
    (example / "mine").touch()
    main(["example", str(example), "--overwrite", "--json"])
    assert not (example / "mine").exists()
    assert json.loads(capsys.readouterr().out) == {"example": str(example), **DESCRIPTION}


def test_the_controllers_are_of_the_surrogate(example):
    surrogate = softfin.load_surrogate(example / "surrogate")
    for name in CONTROLLERS:
        origin = artifacts.load_description(example / name, "controller")["provenance"]
        assert origin["plant_identity"] == identity(surrogate), name
        assert origin["softfin"] == DESCRIPTION["provenance"]["softfin"]
        assert softfin.load_controller(example / name).artifact.name == name
        assert {name, f"{name}-feedback"} <= DESCRIPTION["errors"].keys()


def test_the_recording_is_a_minute_that_imports_without_a_question(example, tmp_path):
    found = softfin.import_logs(example / "recordings", out=tmp_path / "dataset")
    dataset = softfin.Dataset.open(tmp_path / "dataset")
    (log,) = dataset.load(dataset.train)
    assert len(log.reading.time) == 60 * RATE_HZ
    assert found["counts"]["error"] == found["counts"]["warning"] == 0


@pytest.mark.slow
def test_its_gaits_hold_forces_in_the_tank(example, tmp_path):
    out = tmp_path / "evaluation"
    asked = ("--reference=2,-1", "--reference=1,1", "--seconds", "10", "--repeats", "1")
    main(["evaluate", str(example / "gaits"), "--plant", "tank", "--out", str(out), *asked])
    mean = json.loads((out / "evaluation.json").read_text())["mean"]
    assert max(mean[axis]["error_n"] for axis in ("x", "y")) < 0.12


def test_the_wheel_holds_it():
    """Hatch takes all of a package but what git ignores."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert build["targets"]["wheel"]["packages"] == ["src/softfin"]
    assert "exclude" not in build["targets"]["wheel"]
    assert EXAMPLE.parent == ROOT / "src/softfin"
    ignored = subprocess.run(
        ["git", "check-ignore", *EXAMPLE.rglob("*")], cwd=ROOT, check=False, capture_output=True
    )
    assert not ignored.stdout
