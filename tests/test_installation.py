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
    how_to_add,
    missing_from,
    what_is_missing,
)
from tests.patience import HANG_S

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def test_the_extras_are_those_of_the_project():
    assert set(EXTRAS) == set(PROJECT["optional-dependencies"])


def test_what_trains_is_no_part_of_what_runs_a_controller():
    core = set(extra_requirements(None))
    learn = set(extra_requirements("learn"))
    assert {"numpy", "canopen", "mcap", "pyyaml"} <= core
    assert {"jax", "pyarrow", "scipy", "matplotlib"} <= learn
    assert not core & learn
    assert missing_from(None) == []


@pytest.mark.parametrize(
    ("source", "command"),
    [
        (
            {"url": "file:///a%20b/softfin.whl", "archive_info": {}},
            '"softfin[x] @ file:///a%20b/softfin.whl"',
        ),
        ({"url": "file:///a%20b", "dir_info": {"editable": True}}, '-e "/a b[x]"'),
        (
            {"url": "https://host/r", "vcs_info": {"vcs": "git", "commit_id": "1a2b"}},
            '"softfin[x] @ git+https://host/r@1a2b"',
        ),
        (None, f'"dist/softfin-{PROJECT["version"]}-py3-none-any.whl[x]"'),
    ],
)
def test_an_extra_is_added_from_where_softfin_came(source, command, monkeypatch):
    """By the installer that is there: an environment of uv has no pip."""
    monkeypatch.setattr(installation, "origin", lambda: source)
    for installer, install in (
        ("pip", "pip install"),
        ("uv", f"uv pip install --python {sys.executable}"),
    ):
        monkeypatch.setattr(installation, "installer", lambda name=installer: name)
        assert how_to_add("x").endswith(f"{install} {command}")
    assert how_to_add("x").startswith("make wheel") == (source is None)


def test_an_extra_that_brings_another_needs_what_that_needs():
    assert set(extra_requirements("learn")) < set(extra_requirements("onnx"))


@pytest.mark.parametrize(
    ("module", "there", "told"),
    [
        ("jax.numpy", None, "missing jax.numpy from the extra 'learn'; to install it, run "),
        (
            "cyclonedds.core",
            None,
            "missing cyclonedds.core from the extra 'ros2'; to install it, run ",
        ),
        (
            "yaml",
            None,
            "missing yaml, which every command requires; reinstall softfin",
        ),
        (
            "jax.extend.no",
            "0.1",
            "missing jax.extend.no, although jax 0.1 is installed; reinstall jax",
        ),
    ],
)
def test_a_module_that_is_not_there_is_told_with_the_way_out(module, there, told, monkeypatch):
    monkeypatch.setattr(installation, "installed_version", lambda _: there)
    assert (what_is_missing(ModuleNotFoundError(name=module)) or "").startswith(told)


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
