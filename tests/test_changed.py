"""Which test files `make test-changed` runs."""

import json
import subprocess

import pytest
from tools import changed
from tools.changed import Repository

FILES = {
    "pyproject.toml": "",
    "uv.lock": "",
    "README.md": "",
    "src/softfin/__init__.py": "",
    "src/softfin/used.py": "from softfin.inner import deep",
    "src/softfin/inner/__init__.py": "",
    "src/softfin/inner/deep.py": "",
    "src/softfin/inner/unused.py": "",
    "src/softfin/cli/__init__.py": "import_module(name)",
    "src/softfin/cli/fit.py": "",
    "src/softfin/data.yaml": "",
    "tests/conftest.py": "",
    "tests/plants.py": "",
    "tests/test_used.py": "from softfin.used import f",
    "tests/test_named.py": "PLANT = 'tests.plants:Fin'",
    "tests/test_cli.py": "from softfin.cli import main",
    "tests/test_readme.py": "ROOT",
}
ALL = {"tests/test_used.py", "tests/test_named.py", "tests/test_cli.py", "tests/test_readme.py"}


@pytest.fixture
def folder(tmp_path):
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "depends"),
    [
        ("src/softfin/used.py", {"tests/test_used.py"}),
        ("src/softfin/inner/deep.py", {"tests/test_used.py"}),
        ("src/softfin/inner/__init__.py", {"tests/test_used.py"}),
        ("src/softfin/inner/unused.py", set()),
        ("src/softfin/cli/fit.py", {"tests/test_cli.py"}),
        ("tests/plants.py", {"tests/test_named.py"}),
        ("tests/test_named.py", {"tests/test_named.py"}),
        ("README.md", set()),
        ("src/softfin/data.yaml", ALL),
        ("uv.lock", ALL),
        ("tests/conftest.py", ALL),
    ],
)
def test_a_test_file_depends_on_what_it_names_and_on_data(folder, name, depends):
    before = Repository(folder).digests()
    (folder / name).write_text("# changed")
    after = Repository(folder).digests()
    assert {test for test in after if before[test] != after[test]} == {
        *depends,
        "tests/test_readme.py",
    }


def test_what_failed_runs_again_and_what_passed_does_not(folder, monkeypatch, capsys):
    cache = folder / ".pytest_cache" / "v" / "cache"
    cache.mkdir(parents=True)
    ran = []

    def run(command, **_):
        ran.append(set(command) & ALL)
        (cache / "lastfailed").write_text(json.dumps({"tests/test_cli.py::test_it": True}))
        return subprocess.CompletedProcess(command, 1)

    listed = subprocess.run

    monkeypatch.setattr(
        changed.subprocess,
        "run",
        lambda command, **options: (listed if command[0] == "git" else run)(command, **options),
    )
    (folder / ".gitignore").write_text(".pytest_cache\nbuild\n")
    assert changed.main(folder) == 1
    assert changed.main(folder) == 1
    assert ran == [ALL, ALL, {"tests/test_cli.py"}, {"tests/test_cli.py"}]
    assert "4 of 4 test files" in capsys.readouterr().out
