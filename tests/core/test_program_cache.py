"""Where compiled programs are kept, and that a cache that cannot be used never stops anything."""

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax._src import compilation_cache

from softfin.cli import main
from softfin.core.program_cache import SUFFIX, ProgramStore, cache_folder, describe_cache, use_program_cache

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_enable_xla_caches",
)


@pytest.fixture
def no_setting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    for name in ("SOFTFIN_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return monkeypatch


@pytest.fixture
def unconfigured_jax(no_setting: pytest.MonkeyPatch) -> Iterator[None]:
    """JAX as it is before anyone has told it where to keep programs."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    no_setting.setattr(compilation_cache, "get_file_cache", compilation_cache.get_file_cache)
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def compile_anew(factor: float) -> float:
    """What a program gives that this process has not compiled before."""
    return float(jax.jit(lambda x: x * factor)(jnp.float32(2)))


def programs(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{SUFFIX}"))


@pytest.mark.usefixtures("no_setting")
def test_programs_are_kept_in_the_cache_folder_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert cache_folder() == tmp_path / ".cache" / "softfin"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert cache_folder() == tmp_path / "other" / "softfin"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == tmp_path / ".cache" / "softfin"


def test_the_help_says_where_programs_are_kept_how_large_that_grows_and_how_to_switch_it_off(
    no_setting: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--help"])
    told = capsys.readouterr().out
    assert f"kept in {tmp_path / '.cache' / 'softfin'}, at most 1 GiB" in told
    assert "SOFTFIN_CACHE=off keeps none" in told
    no_setting.setenv("SOFTFIN_CACHE", "~/moved")
    assert f"kept in {tmp_path / 'moved'}, at most 1 GiB" in describe_cache()
    no_setting.setenv("SOFTFIN_CACHE", "off")
    assert describe_cache() == "Compiled programs are not kept; SOFTFIN_CACHE=FOLDER keeps them."
    no_setting.setenv("JAX_COMPILATION_CACHE_DIR", "/elsewhere")
    assert describe_cache() == "Compiled programs are kept in /elsewhere (JAX_COMPILATION_CACHE_DIR)."


COMMAND = """
import sys
import softfin.core.program_cache
{entry_point}
assert "jax" not in sys.modules
import softfin.core.plant
import jax
print(jax.config.jax_compilation_cache_dir)
"""


@pytest.mark.parametrize(
    ("entry_point", "kept_in"),
    [("import softfin.cli; sys.argv = ['softfin', '--version']; softfin.cli.script()", "moved"), ("", None)],
    ids=["the command", "a library"],
)
def test_the_command_keeps_programs_and_an_import_of_the_library_does_not(
    entry_point: str, kept_in: str | None, no_setting: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    no_setting.setenv("SOFTFIN_CACHE", str(tmp_path / "moved"))
    code = COMMAND.format(entry_point=entry_point)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == str(kept_in and tmp_path / kept_in)


@pytest.mark.usefixtures("unconfigured_jax")
def test_a_program_is_compiled_once_and_read_from_then_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "moved"))
    use_program_cache()
    hits: list[str] = []
    monkeypatch.setattr("jax._src.compiler.log_persistent_cache_hit", lambda name, key: hits.append(name))
    assert compile_anew(3.25) == compile_anew(3.25) == 6.5
    assert hits == ["jit__lambda"]
    kept = programs(tmp_path / "moved")
    assert any(path.name.startswith("jit__lambda-") for path in kept)
    assert sorted((tmp_path / "moved").iterdir()) == kept


@pytest.mark.usefixtures("unconfigured_jax")
def test_a_damaged_program_is_never_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """JAX's own store reads most flipped bits without noticing, and the program may then give anything."""
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "moved"))
    use_program_cache()
    hits: list[str] = []
    monkeypatch.setattr("jax._src.compiler.log_persistent_cache_hit", lambda name, key: hits.append(name))
    compile_anew(3.125)
    (entry,) = (path for path in programs(tmp_path / "moved") if path.name.startswith("jit__lambda-"))
    whole = entry.read_bytes()
    for place in range(0, len(whole), len(whole) // 40):
        entry.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert compile_anew(3.125) == 6.25
    assert hits == []
    assert compile_anew(3.125) == 6.25
    assert hits == ["jit__lambda"]


@pytest.mark.usefixtures("unconfigured_jax")
def test_what_the_user_has_told_jax_wins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "moved"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.25)
    use_program_cache()
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.25
    # Later, and before: the entries are JAX's own.
    for own in (tmp_path / "later", tmp_path / "before"):
        jax.config.update("jax_compilation_cache_dir", str(own))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        compilation_cache.reset_cache()
        use_program_cache()
        assert jax.config.jax_compilation_cache_dir == str(own)
        assert compile_anew(3.5) == 7
        assert list(own.iterdir())
        assert programs(own) == []
    assert not (tmp_path / "moved").exists()


@pytest.mark.usefixtures("unconfigured_jax")
def test_switched_off_it_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOFTFIN_CACHE", "off")
    use_program_cache()
    assert jax.config.jax_compilation_cache_dir is None
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 1


@pytest.mark.usefixtures("unconfigured_jax")
def test_a_folder_that_cannot_be_written_is_one_line_and_the_program_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "file" / "cache"))
    use_program_cache()
    assert (compile_anew(3.75), compile_anew(4.25)) == (7.5, 8.5)
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err == (
        f"softfin: {tmp_path / 'file' / 'cache'}: compiled programs cannot be kept (Not a directory); "
        "SOFTFIN_CACHE=FOLDER keeps them elsewhere, SOFTFIN_CACHE=off keeps none\n"
    )


def test_a_full_disk_leaves_no_part_of_an_entry(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    store = ProgramStore(tmp_path)
    monkeypatch.setattr(Path, "replace", full)
    store.put("program", b"content")
    store.put("program", b"content")
    assert store.get("program") is None
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("damage", [lambda data: data[:35], lambda data: b"", lambda data: data[:-1] + b"!"])
def test_a_damaged_entry_is_compiled_again_and_replaced(tmp_path: Path, damage) -> None:  # type: ignore[no-untyped-def]
    store = ProgramStore(tmp_path)
    store.put("program", b"content")
    (entry,) = programs(tmp_path)
    entry.write_bytes(damage(entry.read_bytes()))
    assert store.get("program") is None
    store.put("program", b"content")
    assert store.get("program") == b"content"


def test_what_was_not_used_for_longest_makes_room_and_no_other_file_is_touched(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("the user's" * 1000)
    store = ProgramStore(tmp_path, largest_bytes=4 * 132)
    for moment, key in enumerate(("first", "second", "third")):
        store.put(key, bytes(100))
        _set_time(tmp_path / f"{key}{SUFFIX}", moment)
    assert store.get("first") == bytes(100)
    store.put("fourth", bytes(100))
    assert [path.stem for path in programs(tmp_path)] == ["first", "fourth", "third"]
    store.put("too large", bytes(600))
    assert [path.stem for path in programs(tmp_path)] == ["first", "fourth", "third"]
    assert (tmp_path / "notes.txt").exists()


def _set_time(path: Path, seconds: float) -> None:
    os.utime(path, (seconds, seconds))


HAMMER = """
import sys
from pathlib import Path
from softfin.core.program_cache import ProgramStore
store = ProgramStore(Path(sys.argv[1]), largest_bytes=6 * 50_000)
for i in range(100):
    key = str(i % 8)
    value = store.get(key)
    assert value in (None, key.encode() * 50_000), (key, len(value))
    store.put(key, key.encode() * 50_000)
"""


def test_processes_that_write_read_and_delete_in_one_folder_never_meet_half_an_entry(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HAMMER, str(tmp_path)]
    workers = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    assert [(worker.communicate()[1], worker.returncode) for worker in workers] == [("", 0)] * 3
    assert sum(path.stat().st_size for path in programs(tmp_path)) <= 6 * 50_000
