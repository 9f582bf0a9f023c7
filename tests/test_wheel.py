"""The wheel, installed into empty environments outside the tree: the robot's part alone, then with
what trains.

``make test-wheel`` builds the wheel and names it, and the Pythons to try it on.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pytest
import yaml

from tests.documents import ROOT
from tests.patience import HANG_S
from tests.rig.rigs import WIDE

PYTHONS = os.environ.get("SOFTFIN_PYTHONS", "").split()
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PYTHONS, reason="installs softfin from a registry; make test-wheel runs it"
    ),
]

LARGEST_MB = 125
"""Files of the robot's part without compiled bytecode, to which pip adds some 30 MB: together at
most 150, but for Python 3.11, whose NumPy is larger."""


def run(words: Sequence[object], folder: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a program outside the tree, as a user would who has nothing of it but the wheel."""
    mine = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(
            ("PYTHON", "VIRTUAL_ENV", "JAX_", "XLA_", "UV_PROJECT", "SOFTFIN_CACHE")
        )
    }
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=mine,
        capture_output=True,
        text=True,
        timeout=2 * HANG_S,
        check=False,
    )
    assert done.returncode == code, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done


@cache
def uv() -> str:
    """The uv of the Makefile, which may be a path within the tree."""
    name = os.environ.get("UV", "uv")
    return str((ROOT / name).absolute()) if "/" in name else name


def wheel() -> Path:
    return ROOT / os.environ["SOFTFIN_WHEEL"] / f"softfin-{VERSION}-py3-none-any.whl"


class Environment:
    """A virtual environment with softfin, and a folder beside it to work in."""

    def __init__(self, folder: Path, python: str) -> None:
        self.folder = folder / "environment"
        self.work = folder / "work"
        self.work.mkdir(parents=True)
        run([uv(), "venv", "--quiet", "--python", python, self.folder], self.work)

    def pip_install(self, *words: object) -> None:
        run(
            [uv(), "pip", "install", "--quiet", "--python", self.folder / "bin" / "python", *words],
            self.work,
        )

    def softfin(self, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        return run([self.folder / "bin" / "softfin", *words], self.work, code)


@pytest.fixture(scope="module", params=PYTHONS)
def robot(request, tmp_path_factory):
    """The robot's part alone, with the versions that were tested."""
    environment = Environment(tmp_path_factory.mktemp("robot"), request.param)
    environment.pip_install("--constraints", wheel().with_name("constraints.txt"), wheel())
    return environment


def test_the_robots_part_has_the_versions_that_were_tested(robot):
    constraints = wheel().with_name("constraints.txt").read_text().splitlines()
    tested = dict(line.split(" ")[0].split("==") for line in constraints if " ;" not in line)
    listed = run(
        [uv(), "pip", "list", "--python", robot.folder / "bin" / "python", "--format=json"],
        robot.work,
    ).stdout
    installed = {package["name"]: package["version"] for package in json.loads(listed)}
    shared = tested.keys() & installed.keys()
    assert {"python-can", "rosbags"} <= shared
    assert {name: installed[name] for name in shared} == {name: tested[name] for name in shared}


@pytest.fixture(scope="module")
def learner(robot, tmp_path_factory):
    """An environment to which the extra was added by the command that a message names."""
    environment = Environment(
        tmp_path_factory.mktemp("learner"), str(robot.folder / "bin" / "python")
    )
    environment.pip_install(wheel())
    told = environment.softfin("collect", "--plant", "tank", "--out", "dataset", code=2).stderr
    assert told.count("\n") == 1
    assert "missing jax from the extra 'learn'; to install it, run pip install " in told
    program, _, *words = shlex.split(told.partition("to install it, run ")[2])
    assert program == "pip"
    environment.pip_install(*words)
    return environment


def test_the_robots_part_is_small_and_has_nothing_that_trains(robot):
    files = [
        path
        for path in robot.folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    ]
    assert sum(path.lstat().st_size for path in files) / 1e6 < LARGEST_MB
    names = {
        re.split(r"[-.]", path.name)[0].lower()
        for path in robot.folder.glob("lib/python*/site-packages/*")
    }
    assert not names & {
        "jax",
        "jaxlib",
        "scipy",
        "pyarrow",
        "matplotlib",
        "torch",
        "onnxruntime",
        "canopen",
    }


@pytest.fixture
def emulated(robot):
    """A rig that the checkout emulates in real time, in the folder where the robot's part works."""
    words = [sys.executable, "-m", "softfin.cli", "rig", "emulate", "--real-time"]
    with subprocess.Popen(words, cwd=robot.work, stdout=subprocess.PIPE, text=True) as emulator:
        try:
            assert "written" in emulator.stdout.readline()
            file = robot.work / "rig.yaml"
            values = yaml.safe_load(file.read_text())
            values["safety"] |= WIDE
            file.write_text(yaml.safe_dump(values))
            yield
        finally:
            emulator.terminate()


def test_the_robots_part_holds_a_force_on_an_emulated_rig(robot, emulated):
    robot.softfin("example", "example")
    robot.softfin("rig", "check", "--prove", "--arm", "--yes")
    robot.softfin("rig", "zero", "--arm", "--yes")
    words = (
        "--reference=2,0",
        "--seconds",
        "6",
        "--bag",
        "run.mcap",
        "--feedback",
        "--arm",
        "--yes",
        "--json",
    )
    result = json.loads(robot.softfin("run", "example/single", *words).stdout)
    assert max(result["error_x_n"], result["error_y_n"]) < 0.3
    assert "not damaged" in robot.softfin("bag", "recover", "run.mcap").stdout


def test_the_robots_part_says_what_emulating_needs(robot):
    told = robot.softfin("rig", "emulate", "--rig", "other.yaml", code=2).stderr
    assert "missing canopen from the extra 'emulation'" in told


def test_the_doctor_of_the_robots_part_finds_nothing_wrong(robot):
    rows = {row["what"]: row for row in json.loads(robot.softfin("doctor", "--json").stdout)}
    assert rows["packages"]["state"] == "well"
    assert "JAX" not in rows
    assert rows["[learn]"]["state"] == "note"
    assert rows["softfin"]["text"].startswith(f"{VERSION}, ")


def test_with_what_trains_a_controller_is_evaluated_in_the_tank(learner):
    learner.softfin("example", "example")
    words = ("--plant", "tank", "--reference=2,0", "--seconds", "3", "--repeats", "1")
    learner.softfin("evaluate", "example/gaits", *words, "--out", "evaluation")
    assert json.loads((learner.work / "evaluation" / "evaluation.json").read_text())
    assert (learner.work / "evaluation" / "experiments.png").is_file()
    rows = {row["what"]: row for row in json.loads(learner.softfin("doctor", "--json").stdout)}
    assert rows["[learn]"]["state"] == rows["JAX"]["state"] == "well"
