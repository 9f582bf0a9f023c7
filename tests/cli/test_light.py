"""What was typed is checked before JAX is imported: help and slips are answered at once."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from softfin.cli import COMMANDS

ANSWER = """
import contextlib, io, json, sys
from softfin.cli import main
answers = []
for words in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
            code = 0
        except SystemExit as stop:
            code = stop.code
    answers.append({"code": code, "out": out.getvalue(), "err": err.getvalue()})
print(json.dumps([answers, sorted({"jax", "jaxlib", "equinox"} & set(sys.modules))]))
"""

OUT = ("--out", "new")
SLIPS: list[tuple[list[str], str]] = [
    (["collect", *OUT, "--plant", "pool"], "plant pool: unknown (does not exist); use tank, "),
    (["collect", *OUT, "--plant", "no_such_module:plant"], "No module named 'no_such_module'"),
    (
        ["collect", *OUT, "--config", "no.yaml"],
        "no.yaml: cannot be read (No such file or directory)",
    ),
    (
        ["collect", "--out", "full"],
        "full: already exists; choose a different --out, or use --overwrite",
    ),
    (["collect", *OUT, "--seed", "-1"], "--seed -1: must be an integer from 0 to"),
    (["collect", *OUT, "--arm"], "--arm: tank is simulated"),
    (
        ["example", "full"],
        "full: already exists; choose a different folder, or use --overwrite to replace it",
    ),
    (["example"], "FOLDER: missing; usage: softfin example "),
    (["fit", *OUT], "DATASET: missing; usage: softfin fit --out DIR "),
    (["fit", "log.csv"], "--out: missing; usage: softfin fit --out DIR "),
    (["fit", "--out"], "--out: missing value; use --out DIR"),
    (["fit", "--resum", "log.csv", *OUT], "--resum: unknown option"),
    (["fit", "--rsm", "log.csv", *OUT], "DATASET: missing; log.csv is the value of --rsm"),
    (["evaluate"], "CONTROLLER: missing; usage: softfin evaluate "),
    (["evaluate", "made", "--repeats", "0"], "--repeats 0: "),
    (["evaluate", "--reference=nan,1"], "--reference nan,1: not a force"),
    (["collect", "--out", ""], ".: is or contains the current folder"),
    (
        ["collect", *OUT, "--excitation.box", "1", "2"],
        '2: unexpected argument; for several values, use --excitation.box "[1, 2]"',
    ),
    (["demo", "more"], "more: unexpected argument; did you mean --out more?"),
    (["collect", "rig", *OUT], "rig: unexpected argument; did you mean --plant rig?"),
    (["rig", "check", "my.yaml"], "my.yaml: unexpected argument; did you mean --rig my.yaml?"),
    (["doctor", "more"], "more: unexpected argument; --help "),
    (
        ["inspect", "nowhere"],
        "nowhere: no such file or folder; use a CSV file, a Parquet file, a ROS 2 bag",
    ),
    (["inspect", "log.csv", "--rate", "-1"], "--rate -1: Input should be greater than 0"),
    (
        ["inspect", "log.csv"],
        "log.csv: no rows of numbers below a header",
    ),
    (["import-logs", "full", *OUT], "full: contains no recordings; supported are .csv, "),
    (["calibrate", "full", *OUT], "full: contains no recordings"),
    (["fit", "log.csv", *OUT, "--model", "oracle"], "surrogate architecture oracle: unknown; use"),
    (["train", "tank", *OUT, "--range", "3"], "reach"),
    (["train", "tank", *OUT, "--controller", "gaits"], "single"),
    (
        ["evaluate", "made", *OUT, "--reference-file", "no.csv"],
        "--reference-file no.csv: cannot be read",
    ),
    (["evaluate", "made", *OUT, "--reference", "one"], "--reference one: not a force"),
    (["explore", "no", "--out", "new.html"], "no: no such folder; it must be a controller"),
    (
        ["explore", "made", "--out", "new.pdf"],
        "--out new.pdf: must end in .html",
    ),
    (
        ["explore", "made", "--out", "new.html", "--plant", "pool"],
        "plant pool: unknown (does not exist); use tank, ",
    ),
    (["explore", "made", "--out", "full"], "--out full: must end in .html"),
    (["rig", "check"], "rig.yaml: cannot be read (No such file or directory); copy the example"),
    (["run", "no", "--reference=1,1"], "no: no such folder; it must be a controller"),
    (
        ["run", "made", "--reference=1,1", "--bag", "a.txt"],
        "--bag a.txt: must end in .mcap",
    ),
    (["bag", "recover", "no.mcap"], "no.mcap: cannot be read"),
    (["monitor", "no.mcap"], "no.mcap: no such file or folder; use a bag"),
]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What a fresh process answers to every --help, then to every slip; JAX stays out of it."""
    folder = tmp_path_factory.mktemp("typed")
    for name in ("full/notes", "made/controller.json", "log.csv"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    asked = [[*name.split(), "--help"] for name in COMMANDS] + [words for words, _ in SLIPS]
    done = subprocess.run(
        [sys.executable, "-c", ANSWER],
        input=json.dumps(asked),
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert sorted(path.name for path in folder.iterdir()) == ["full", "log.csv", "made"]
    answered, heavy = json.loads(done.stdout)
    assert heavy == []
    return answered


def test_help_of_every_command_needs_no_jax(answers: Any) -> None:
    for name, answer in zip(COMMANDS, answers, strict=False):
        assert answer["err"] == ""
        assert answer["out"].startswith(f"Usage: softfin {name}")
        assert "--json" in answer["out"]


def test_a_slip_is_one_line_before_jax_is_imported(answers: Any) -> None:
    for (words, expected), answer in zip(SLIPS, answers[len(COMMANDS) :], strict=True):
        assert expected in answer["err"], words
        assert answer["err"].count("\n") == 1, words
        assert (answer["code"], answer["out"]) == (2, ""), words


def test_a_command_lets_numpy_count_on_one_thread_unless_the_user_says_otherwise() -> None:
    """Threads of OpenBLAS spin while they wait; their number is read when NumPy is imported, so not
    before that."""
    code = (
        "import os, sys, softfin.cli; assert 'numpy' not in sys.modules\n"
        "try: softfin.cli.main(['inspect', 'nowhere'])\n"
        "except SystemExit: print(os.environ.get('OPENBLAS_NUM_THREADS'))"
    )
    rest = {
        name: value
        for name, value in os.environ.items()
        if name not in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    }

    def threads(**given: str) -> str:
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, env=rest | given, capture_output=True, text=True, check=True
        ).stdout.strip()

    assert threads() == "1"
    assert threads(OPENBLAS_NUM_THREADS="3") == "3"
    assert threads(OMP_NUM_THREADS="2") == "None"
