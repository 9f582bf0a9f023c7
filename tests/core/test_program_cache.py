"""Where compiled programs are kept."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from softfin.cli import main
from softfin.core.program_cache import (
    JAX_SETTINGS,
    cache_folder,
    describe_cache,
    use_program_cache,
)

PROGRAM = """
from softfin.core.program_cache import use_program_cache
use_program_cache()
import jax
print(jax.jit(lambda x: 3 * x)(2.0))
"""


@pytest.fixture
def no_setting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    for name in ("SOFTFIN_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME", *JAX_SETTINGS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return monkeypatch


def test_programs_are_kept_in_the_cache_folder_of_the_user(
    no_setting: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_folder() == tmp_path / ".cache" / "softfin"
    no_setting.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert cache_folder() == tmp_path / "other" / "softfin"
    no_setting.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == tmp_path / ".cache" / "softfin"
    no_setting.setenv("SOFTFIN_CACHE", "off")
    assert cache_folder() is None
    no_setting.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "jax"))
    assert cache_folder() == tmp_path / "jax"


def test_a_user_without_a_home_has_no_cache(no_setting: pytest.MonkeyPatch) -> None:
    no_setting.setenv("SOFTFIN_CACHE", "~nobody-of-this-name/programs")
    assert cache_folder() is None


def test_the_help_says_where_programs_are_kept_and_how_to_switch_it_off(
    no_setting: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--help"])
    told = capsys.readouterr().out
    assert f"cached in {tmp_path / '.cache' / 'softfin'}" in told
    assert "SOFTFIN_CACHE=off to turn the cache off" in told
    no_setting.setenv("SOFTFIN_CACHE", "~/moved")
    assert f"cached in {tmp_path / 'moved'}" in describe_cache()
    no_setting.setenv("SOFTFIN_CACHE", "off")
    assert describe_cache() == (
        "Compiled programs are not cached; set SOFTFIN_CACHE=FOLDER to cache them."
    )


def run_program(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM],
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_second_run_reads_the_programs_of_the_first(
    no_setting: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "programs"
    assert run_program(SOFTFIN_CACHE=str(folder)) == "6.0\n"
    written = {path: path.stat().st_mtime_ns for path in folder.glob("*-cache")}
    assert written
    assert run_program(SOFTFIN_CACHE=str(folder)) == "6.0\n"
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*-cache")} == written


def test_a_cache_that_is_off_sets_nothing(no_setting: pytest.MonkeyPatch) -> None:
    no_setting.setenv("SOFTFIN_CACHE", "off")
    before = dict(os.environ)
    use_program_cache()
    assert dict(os.environ) == before


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_stops_nothing(
    no_setting: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    environment = os.environ | {"SOFTFIN_CACHE": str(tmp_path / "file" / "programs")}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True
    )
    assert (done.stdout, done.stderr) == ("6.0\n", "")
