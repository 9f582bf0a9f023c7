import errno
import json
import math
import os
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ArtifactError, RunError
from softfin.stages import robot
from softfin.stages.collect import collect
from softfin.stages.evaluation import evaluate
from softfin.stages.logs import import_logs, inspect_logs
from softfin.stages.surrogates import calibrate, fit
from softfin.storage import artifact as artifacts
from softfin.storage.formats import FOLDERS
from softfin.storage.run_directory import RunDirectory

HEAD = {"kind": "surrogate", "format": FOLDERS["surrogate"]}
"""Beginning of each description."""


def files_in(path):
    return sorted(file.name for file in path.iterdir())


def test_a_folder_comes_back_as_it_was_saved(tmp_path):
    weights = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "count": np.int32(7)}
    artifacts.save(tmp_path / "thing", "surrogate", {"x": 1, "array": np.float32(2)}, weights)
    description, loaded = artifacts.load(tmp_path / "thing", "surrogate")
    assert description == HEAD | {"x": 1, "array": 2.0}
    np.testing.assert_array_equal(loaded["a"], weights["a"])
    assert loaded["count"].shape == ()


@pytest.mark.parametrize(
    "failure", [KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")]
)
def test_a_failed_write_leaves_what_was_there(tmp_path, failure):
    artifacts.save(tmp_path / "thing", "surrogate", {"version": 1}, {})

    def write(folder):
        (folder / "half").write_text("x")
        raise failure

    with pytest.raises((KeyboardInterrupt, RunError)) as error:
        artifacts.write_folder(tmp_path / "thing", write, overwrite=True)
    assert files_in(tmp_path) == ["thing"]
    assert artifacts.load_description(tmp_path / "thing", "surrogate") == HEAD | {"version": 1}
    if isinstance(failure, OSError):
        assert "thing: cannot be written (No space left on device)" in str(error.value)


def test_a_folder_is_replaced_whole(tmp_path):
    for version in (1, 2):
        artifacts.save(
            tmp_path / "thing", "surrogate", {"version": version}, {}, overwrite=version == 2
        )
    assert artifacts.load_description(tmp_path / "thing", "surrogate") == HEAD | {"version": 2}
    assert files_in(tmp_path) == ["thing"]


def test_what_a_kill_left_neither_stops_a_writer_nor_is_touched_by_a_reader(tmp_path):
    for leftover in (".thing.old", ".thing.partial"):
        (tmp_path / leftover).mkdir()
        (tmp_path / leftover / "surrogate.json").write_text("{}")
    with pytest.raises(ArtifactError, match="no such folder"):
        artifacts.load(tmp_path / "thing", "surrogate")
    assert files_in(tmp_path) == [".thing.old", ".thing.partial"]
    for version in (1, 2):
        artifacts.save(tmp_path / "thing", "surrogate", {"version": version}, {}, overwrite=True)
        assert artifacts.load(tmp_path / "thing", "surrogate")[0] == HEAD | {"version": version}


def test_a_finished_result_is_kept_where_its_place_was_taken_meanwhile(tmp_path):
    def write(folder):
        (folder / "result").write_text("hours of work")
        (tmp_path / "thing").mkdir()
        (tmp_path / "thing" / "surrogate.json").write_text("{}")

    with pytest.raises(
        RunError, match=r"thing: already exists; .*the finished result is in .*partial; rename it"
    ):
        artifacts.write_folder(tmp_path / "thing", write)
    (kept,) = tmp_path.glob(".thing.*.partial")
    assert (kept / "result").read_text() == "hours of work"


def test_what_was_there_is_restored_if_its_replacement_cannot_be_renamed(tmp_path, monkeypatch):
    def refuse(place, to):
        if place.suffix == ".partial":
            raise OSError(errno.EIO, "Input/output error")
        return rename(place, to)

    rename = Path.rename
    artifacts.save(tmp_path / "thing", "surrogate", {"version": 1}, {})
    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(RunError, match=r"the finished result is in .*partial; rename it"):
        artifacts.save(tmp_path / "thing", "surrogate", {"version": 2}, {}, overwrite=True)
    assert artifacts.load_description(tmp_path / "thing", "surrogate") == HEAD | {"version": 1}
    assert not list(tmp_path.glob("*.before"))


@pytest.mark.parametrize(
    "stage",
    [
        partial(collect, plant="none"),
        partial(fit, "logs"),
        partial(calibrate, "none"),
        partial(inspect_logs, "logs"),
        partial(import_logs, "logs"),
        partial(evaluate, "controller"),
        partial(robot.evaluate, "robot.yaml"),
    ],
)
def test_a_stage_replaces_only_folders_of_the_kind_that_it_writes(tmp_path, monkeypatch, stage):
    monkeypatch.chdir(tmp_path)
    artifacts.save(tmp_path / "controller", "controller", {}, {})
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "train.csv").touch()
    with pytest.raises(ArtifactError, match=r"controller: .*so it is not replaced.*--out"):
        stage(out="controller", overwrite=True)


def test_a_file_is_on_the_disk_before_it_is_in_its_place(tmp_path, monkeypatch):
    def note(descriptor):
        place = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append((place.relative_to(tmp_path).as_posix(), (tmp_path / "file").exists()))
        fsync(descriptor)

    synced = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", note)
    artifacts.write_file(tmp_path / "file", "x")
    assert synced == [(f".file.{os.getpid()}.partial", False), (".", True)]


def test_files_that_were_written_are_closed(tmp_path):
    before = files_in(Path("/proc/self/fd"))
    for number in range(20):
        artifacts.write_file(tmp_path / "file", str(number))
    assert files_in(Path("/proc/self/fd")) == before


def test_an_empty_folder_is_a_vacant_place(tmp_path):
    artifacts.check_vacant(tmp_path)


@pytest.mark.parametrize("there", [{}, {"surrogate.json": "{}"}])
def test_a_folder_is_replaced_only_where_that_was_asked(tmp_path, there):
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "mine").write_text("precious")
    for name, text in there.items():
        (tmp_path / "thing" / name).write_text(text)
    with pytest.raises(ArtifactError, match="exists"):
        artifacts.write_folder(tmp_path / "thing", lambda folder: None, overwrite=not there)
    assert (tmp_path / "thing" / "mine").read_text() == "precious"


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    for out, why in (
        (tmp_path / "file" / "a" / "out", "Not a directory"),
        (tmp_path / ("x" * 300), "name too long"),
    ):
        with pytest.raises(
            ArtifactError, match=rf"(out|x): cannot be written .*{why}.*choose a different --out"
        ):
            artifacts.check_vacant(out)
    assert files_in(tmp_path) == ["file"]


def test_nothing_of_the_user_is_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ArtifactError, match="not a softfin folder, so it is not replaced"):
        artifacts.check_vacant(tmp_path, overwrite=True)
    for text in ("{}", "[]", "{", '{"kind": "example"}'):
        (tmp_path / "robot.json").write_text(text)
        with pytest.raises(ArtifactError, match="not a softfin folder, so it is not replaced"):
            artifacts.check_vacant(tmp_path, overwrite=True)
    artifacts.save(tmp_path / "s", "surrogate", {}, {})
    with pytest.raises(ArtifactError, match="choose a different --out, or use --overwrite"):
        artifacts.check_vacant(tmp_path / "s")
    artifacts.check_vacant(tmp_path / "s", overwrite=True)
    artifacts.check_vacant(tmp_path / "new")


@pytest.mark.parametrize("text", ["{", "[]", "\x00", "[" * 100_000])
def test_a_damaged_description_is_refused_by_name(tmp_path, text):
    (tmp_path / "surrogate.json").write_text(text)
    with pytest.raises(ArtifactError, match=r"surrogate\.json: "):
        artifacts.load(tmp_path, "surrogate")


@pytest.mark.parametrize(("kind", "size"), [("F8_E4M3", 2), ("BF16", 4), ("C64", 16)])
def test_weights_that_are_no_real_numbers_of_numpys_are_refused_in_one_line(tmp_path, kind, size):
    artifacts.save(tmp_path / "s", "surrogate", {}, {})
    header = json.dumps({"a": {"dtype": kind, "shape": [2], "data_offsets": [0, size]}}).encode()
    (tmp_path / "s" / artifacts.WEIGHTS).write_bytes(
        len(header).to_bytes(8, "little") + header + bytes(size)
    )
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: truncated or damaged"):
        artifacts.load(tmp_path / "s", "surrogate")


def test_a_missing_folder_and_missing_weights_are_told_apart(tmp_path):
    with pytest.raises(ArtifactError, match="no such folder; it must be a controller"):
        artifacts.load(tmp_path / "none", "controller")
    artifacts.write_description(tmp_path, "controller", {})
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: missing"):
        artifacts.load(tmp_path, "controller")


def test_provenance_names_seed_versions_and_time():
    metadata = json.loads(artifacts.dump_json(artifacts.provenance(seed=3)))
    assert metadata["seed"] == 3
    assert {"softfin", "jax", "numpy", "python", "git_commit", "created"} <= set(metadata)


def test_numbers_that_are_not_finite_are_null_wherever_they_stand():
    value = {
        "number": math.inf,
        "numpy": np.float32("nan"),
        "whole": np.int64(3),
        "array": np.array([1.5, -np.inf]),
        "jax": jnp.array([[jnp.nan, 2.0]]),
        "deep": [{"pair": (1, math.nan)}],
        "text": "inf",
        "path": Path("a"),
    }
    assert json.loads(artifacts.dump_json(value)) == {
        "number": None,
        "numpy": None,
        "whole": 3,
        "array": [1.5, None],
        "jax": [[None, 2.0]],
        "deep": [{"pair": [1, None]}],
        "text": "inf",
        "path": "a",
    }


def test_a_training_log_is_standard_json(tmp_path):
    log = RunDirectory(tmp_path / "out", {}).log()
    log.write(3, loss=0.5, kl=math.nan)
    assert log.path.read_text() == '{"step": 3, "loss": 0.5, "kl": null}\n'
