"""What was typed is looked at before anything heavy is imported: all is answered with the standard library alone."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from softfin.cli import COMMANDS

ANSWER = """
import contextlib, importlib, io, json, sys
before = set(sys.modules)
from softfin.cli import main
answers = {}
for name, words in json.load(sys.stdin).items():
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words) if words else importlib.import_module(name)
            code = None
        except SystemExit as stop:
            code = stop.code
    loaded = {module.partition(".")[0] for module in set(sys.modules) - before}
    foreign = sorted(loaded - set(sys.stdlib_module_names) - {"softfin", "lazy_loader"})
    answers[name] = {"code": code, "out": out.getvalue(), "err": err.getvalue(), "foreign": foreign}
    before = set(sys.modules)
print(json.dumps(answers))
"""

OUT = ("--out", "new")
CASES: dict[str, list[tuple[list[str], str]]] = {
    "collect": [
        ([*OUT, "--plant", "pool"], "plant pool: unknown (does not exist); give tank, "),
        ([*OUT, "--plant", "no_such_module:plant"], "No module named 'no_such_module'"),
        ([*OUT, "--plant", "rig:no.yaml"], "no.yaml: no such file; docs/rig.md has one"),
        ([*OUT, "--surrogate", "no"], "no: no such folder; it should be a surrogate"),
        ([*OUT, "--extend", "."], ".: not a dataset: it holds no dataset.json"),
        ([*OUT, "--config", "no.yaml"], "no.yaml: cannot be read (No such file or directory)"),
        (["--out", "full"], "full: exists already; give another --out, or --overwrite"),
        ([*OUT, "--excitation", "actve"], "choose one of random, active; did you mean active?"),
        ([*OUT, "--seed", "-1"], "--seed -1: a seed is a whole number from 0 to"),
        ([*OUT, "--arm"], "--arm: tank is simulated"),
    ],
    "inspect": [(["nowhere"], "nowhere: no such file or folder; give a folder of CSV, Parquet or ROS 2 bags")],
    "import-logs": [(["full", *OUT], "full: holds no recordings; they are .csv, ")],
    "fit": [
        (["nowhere", *OUT], "nowhere: no such file or folder"),
        (["log.csv", *OUT, "--epochs", "3"], "only --model paper counts in epochs"),
    ],
    "calibrate": [
        (["pool", *OUT], "plant pool: unknown"),
        (["full", *OUT], "full: not a dataset"),
        (["tank", *OUT, "--velocity", "3"], "--velocity 3: no range; write LOW,HIGH"),
    ],
    "import-keras": [(["a.keras", "b.keras", "--scalers", "s.json", *OUT], "s.json: cannot be read")],
    "compare": [
        (["no", "--dataset", "no", *OUT], "no: no such folder; it should be a surrogate"),
        (["no", "--dataset", "no", *OUT, "--horizons", "soon"], "--horizons soon: not numbers"),
    ],
    "map": [(["pool", *OUT], "plant pool: unknown")],
    "train": [
        (["pool", *OUT], "plant pool: unknown"),
        (["tank", *OUT, "--map", "no"], "no: no such folder; it should be a map"),
        (["tank", *OUT, "--cells", "3"], "--cells 3: neither paper, nor a lattice such as 3x3"),
        (["tank", *OUT, "--range", "3"], "--range 3: not four numbers"),
        (["tank", *OUT, "--seeds", "few"], "--seeds few: neither a number nor a list"),
        (["tank", *OUT, "--controller", "gaits", "--steps", "3"], "--steps: gaits are found, not trained"),
    ],
    "evaluate": [
        (["no", *OUT], "no: no such folder; it should be a controller"),
        (["made", *OUT, "--plant", "pool"], "plant pool: unknown"),
        (["made", *OUT, "--reference-file", "no.csv"], "--reference-file no.csv: cannot be read"),
        (["made", *OUT, "--reference", "one"], "--reference=one: not a force"),
    ],
    "baselines": [
        ([*OUT, "--plant", "pool"], "plant pool: unknown"),
        ([*OUT, "--surrogate", "pool"], "plant pool: unknown"),
    ],
    "view": [
        (["--out", "film.avi"], "--out film.avi: a view is written as .gif"),
        (["--out", "a.png", "--controller", "no"], "no: no such folder; it should be a controller"),
    ],
    "rig": [(["chek"], "'chek': choose one of check, zero, emulate"), (["check"], "rig.yaml: no such file")],
    "run": [
        (["no", "--reference=1,1"], "no: no such folder; it should be a controller"),
        (["made", "--reference=1,1"], "rig.yaml: no such file"),
        (["made", "--reference=1,1", "--plant", "tank"], "--plant tank: is not a real fin"),
        (["made", "--reference=1,1", "--bag", "a.txt"], "--bag a.txt: a recording is a file NAME.mcap"),
    ],
    "bag": [
        (["recover", "no.mcap"], "no.mcap: cannot be read"),
        (["convert", "no.mcap", "--out", "a.parquet"], "no.mcap: no such file"),
    ],
    "monitor": [(["no.mcap"], "no.mcap: not there; give a bag")],
    "ros2": [(["no", "--reference=1,1"], "no: no such folder; it should be a controller")],
    "export": [
        (["no", "--onnx", "a.onnx"], "no: no such folder; it should be a controller"),
        (["made", "--onnx", "log.csv"], "log.csv: exists already"),
    ],
    "reproduce": [
        ([*OUT, "--plant", "pool"], "plant pool: unknown"),
        ([*OUT, "--preset", "bets"], "--preset bets: choose one of demo, best, "),
    ],
}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What a fresh process answers to every case, and which modules it has loaded by then."""
    folder = tmp_path_factory.mktemp("typed")
    for name in ("full", "made"):
        (folder / name).mkdir()
    for name in ("full/notes", "made/controller.json", "log.csv"):
        (folder / name).touch()
    asked: dict[str, list[str]] = {}
    for name in COMMANDS:
        asked[f"softfin.cli.{name.replace('-', '_')}"] = []
        asked[f"{name} --help"] = [name, "--help"]
        asked[f"{name} --zzz"] = [name, "--zzz"]
        for words, _ in CASES[name]:
            asked[" ".join([name, *words])] = [name, *words]
    done = subprocess.run(
        [sys.executable, "-c", ANSWER], input=json.dumps(asked), cwd=folder, capture_output=True, text=True, check=True
    )
    assert sorted(path.name for path in folder.iterdir()) == ["full", "log.csv", "made"]
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_imported_and_explained_by_the_standard_library_alone(answers: Any, name: str) -> None:
    assert answers[f"softfin.cli.{name.replace('-', '_')}"]["foreign"] == []
    explained, refused = answers[f"{name} --help"], answers[f"{name} --zzz"]
    assert (explained["code"], explained["err"], explained["foreign"]) == (0, "", [])
    assert explained["out"].startswith(f"usage: softfin {name} ")
    assert refused["err"].startswith(f"softfin {name}: --zzz: unknown option")
    assert (refused["code"], refused["foreign"]) == (2, [])


@pytest.mark.parametrize(
    ("words", "expected"), [(" ".join([name, *words]), line) for name in COMMANDS for words, line in CASES[name]]
)
def test_a_wrong_path_or_name_is_one_line_before_anything_heavy_is_imported(
    answers: Any, words: str, expected: str
) -> None:
    answer = answers[words]
    assert expected in answer["err"]
    assert answer["err"].count("\n") == 1
    assert (answer["code"], answer["out"], answer["foreign"]) == (2, "", [])


def test_the_light_modules_stay_light() -> None:
    light = ("storage.artifact", "core.choices", "core.errors", "storage.paths", "storage.registry", "task.notation")
    code = "; ".join(["import sys", "before = set(sys.modules)", *(f"import softfin.{name}" for name in light)])
    code += "; print(*{name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert sorted(done.stdout.split()) == ["lazy_loader", "softfin"]


def test_every_module_of_a_command_is_named_here() -> None:
    assert set(CASES) == set(COMMANDS)
    assert all((Path(__file__).parents[2] / "src/softfin/cli" / f"{name.replace('-', '_')}.py").is_file()
               for name in COMMANDS)  # fmt: skip
