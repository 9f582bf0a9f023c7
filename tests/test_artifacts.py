import errno
import json
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from softfin import artifacts
from softfin.checkpoint import Workspace
from softfin.errors import ArtifactError, RunError


def files_in(path):
    return sorted(file.name for file in path.iterdir())


def test_a_folder_comes_back_as_it_was_saved(tmp_path):
    weights = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "count": np.int32(7)}
    artifacts.save(tmp_path / "thing", "surrogate", {"x": 1, "array": np.float32(2)}, weights)
    description, loaded = artifacts.load(tmp_path / "thing", "surrogate")
    assert description == {"x": 1, "array": 2.0}
    np.testing.assert_array_equal(loaded["a"], weights["a"])
    assert loaded["count"].shape == ()


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")])
def test_a_failed_write_leaves_what_was_there(tmp_path, failure):
    artifacts.save(tmp_path / "thing", "surrogate", {"version": 1}, {})

    def write(folder):
        (folder / "half").write_text("x")
        raise failure

    with pytest.raises((KeyboardInterrupt, RunError)) as error:
        artifacts.write_folder(tmp_path / "thing", write)
    assert files_in(tmp_path) == ["thing"]
    assert artifacts.load_description(tmp_path / "thing", "surrogate") == {"version": 1}
    if isinstance(failure, OSError):
        assert "thing: cannot be written (No space left on device)" in str(error.value)


def test_a_folder_is_replaced_whole(tmp_path):
    for version in (1, 2):
        artifacts.save(tmp_path / "thing", "surrogate", {"version": version}, {})
    assert artifacts.load_description(tmp_path / "thing", "surrogate") == {"version": 2}
    assert files_in(tmp_path) == ["thing"]


def test_nothing_of_the_user_is_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ArtifactError, match="no folder of softfin's, so it is not replaced"):
        artifacts.check_vacant(tmp_path, overwrite=True)
    artifacts.save(tmp_path / "s", "surrogate", {}, {})
    with pytest.raises(ArtifactError, match="give another --out, or --overwrite"):
        artifacts.check_vacant(tmp_path / "s")
    artifacts.check_vacant(tmp_path / "s", overwrite=True)
    artifacts.check_vacant(tmp_path / "new")


@pytest.mark.parametrize("text", ["{", "[]", "\x00"])
def test_a_damaged_description_is_refused_by_name(tmp_path, text):
    (tmp_path / "surrogate.json").write_text(text)
    with pytest.raises(ArtifactError, match=r"surrogate\.json: "):
        artifacts.load(tmp_path, "surrogate")


def test_a_missing_folder_and_missing_weights_are_told_apart(tmp_path):
    with pytest.raises(ArtifactError, match="no such folder; it should be a controller"):
        artifacts.load(tmp_path / "none", "controller")
    (tmp_path / "controller.json").write_text("{}")
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: missing"):
        artifacts.load(tmp_path, "controller")


def test_provenance_names_seed_versions_and_time():
    facts = json.loads(artifacts.dump_json(artifacts.provenance(seed=3)))
    assert facts["seed"] == 3
    assert {"softfin", "jax", "numpy", "python", "git_commit", "created"} <= set(facts)


def test_numbers_that_are_not_finite_are_null_wherever_they_stand():
    value = {
        "number": math.inf, "numpy": np.float32("nan"), "whole": np.int64(3), "array": np.array([1.5, -np.inf]),
        "jax": jnp.array([[jnp.nan, 2.0]]), "deep": [{"pair": (1, math.nan)}], "text": "inf", "path": Path("a"),
    }  # fmt: skip
    assert json.loads(artifacts.dump_json(value)) == {
        "number": None, "numpy": None, "whole": 3, "array": [1.5, None], "jax": [[None, 2.0]],
        "deep": [{"pair": [1, None]}], "text": "inf", "path": "a",
    }  # fmt: skip


def test_a_training_log_is_standard_json(tmp_path):
    log = Workspace(tmp_path / "out", {}).log()
    log.write(3, loss=0.5, kl=math.nan)
    log.close()
    assert log.path.read_text() == '{"step": 3, "loss": 0.5, "kl": null}\n'
