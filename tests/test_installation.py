"""What softfin says of how it was installed, and of what is not there."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from softfin import installation
from softfin.installation import EXTRAS, extra_of, how_to_add, missing_from, requirements_of

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def test_the_extras_are_those_of_the_project():
    assert set(EXTRAS) == set(PROJECT["optional-dependencies"])


def test_what_trains_is_no_part_of_what_runs_a_controller():
    core, learn = set(requirements_of(None)), set(requirements_of("learn"))
    assert {"numpy", "canopen", "mcap", "pyyaml"} <= core
    assert {"jax", "pyarrow", "scipy", "matplotlib", "tensorboardx"} <= learn
    assert not core & learn
    assert missing_from(None) == []


@pytest.mark.parametrize(
    ("source", "command"),
    [
        (
            {"url": "file:///a%20b/softfin.whl", "archive_info": {}},
            'pip install "softfin[x] @ file:///a%20b/softfin.whl"',
        ),
        ({"url": "file:///a%20b", "dir_info": {"editable": True}}, 'pip install -e "/a b[x]"'),
        ({"url": "https://host/r", "vcs_info": {"vcs": "git"}}, 'pip install "softfin[x] @ git+https://host/r"'),
        (None, 'make wheel, in a checkout of softfin, then pip install "dist/softfin-'),
    ],
)
def test_an_extra_is_added_from_where_softfin_came(source, command, monkeypatch):
    monkeypatch.setattr(installation, "origin", lambda: source)
    assert how_to_add("x").startswith(command)
    assert "[x]" in how_to_add("x")


@pytest.mark.parametrize(("module", "extra"), [("jax.numpy", "learn"), ("PIL", "learn"), ("cyclonedds.core", "ros2"),
                                               ("softfin.no", None), ("os", None)])  # fmt: skip
def test_a_module_that_is_not_there_is_of_an_extra_or_of_none(module, extra):
    assert extra_of(ModuleNotFoundError(f"No module named {module!r}", name=module)) == extra


def test_a_command_without_what_it_needs_names_the_extra_in_one_line(tmp_path):
    code = "import sys; sys.modules['jax'] = None; from softfin.cli import main; main(sys.argv[1:])"
    words = ("collect", "--out", "dataset", "--plant", "tank")
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("softfin collect: needs jax, of the extra 'learn', which is not installed: ")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
