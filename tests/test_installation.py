"""What softfin says of how it was installed, and of what is not there."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from softfin import installation
from softfin.installation import (
    EXTRAS,
    extra_requirements,
    what_is_missing,
)
from tests.patience import HANG_S

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def test_the_extras_are_those_of_the_project():
    assert set(EXTRAS) == set(PROJECT["optional-dependencies"])


def test_what_trains_is_no_part_of_what_runs_a_controller():
    core = set(extra_requirements(None))
    learn = set(extra_requirements("learn"))
    assert {"numpy", "python-can", "mcap", "pyyaml"} <= core
    assert {"jax", "pyarrow", "scipy", "matplotlib"} <= learn
    assert not core & learn


def test_an_extra_that_brings_another_needs_what_that_needs():
    assert set(extra_requirements("learn")) < set(extra_requirements("sb3"))


@pytest.mark.parametrize(
    ("module", "there", "told"),
    [
        (
            "jax.numpy",
            None,
            "missing jax.numpy from the extra 'learn'; to install it, run "
            'pip install "softfin[learn]"',
        ),
        (
            "canopen",
            None,
            "missing canopen from the extra 'emulation'; to install it, run "
            'pip install "softfin[emulation]"',
        ),
        ("yaml", None, "missing yaml; reinstall pyyaml"),
        ("jax.extend.no", "0.1", "missing jax.extend.no; reinstall jax"),
    ],
)
def test_a_module_that_is_not_there_is_told_with_the_way_out(module, there, told, monkeypatch):
    monkeypatch.setattr(installation, "installed_version", lambda _: there)
    assert what_is_missing(ModuleNotFoundError(name=module)) == told


@pytest.mark.parametrize("module", ["softfin.no", "os"])
def test_a_module_that_softfin_does_not_need_is_a_bug(module):
    assert what_is_missing(ModuleNotFoundError(name=module)) is None


@pytest.mark.parametrize(
    ("module", "told"),
    [
        ("jax", "missing jax from the extra 'learn'; to install it, run "),
        ("pydantic", "missing pydantic"),
    ],
)
def test_a_command_without_what_it_needs_says_so_in_one_line(module, told, tmp_path):
    code = (
        f"import sys; sys.modules[{module!r}] = None; import softfin.installation as installation\n"
        "installation.installed_version = lambda name: None; from softfin.cli import main; "
        "main(sys.argv[1:])"
    )
    words = ("collect", "--out", "dataset", "--plant", "tank") if module == "jax" else ("doctor",)
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"softfin {words[0]}: {told}")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
