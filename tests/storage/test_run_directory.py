"""Checkpoints: leaves by name, strictly, and only those of the software that reads them."""

import re
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from softfin.core.errors import ArtifactError, RunError
from softfin.storage import run_directory as checkpoint
from softfin.storage.run_directory import CHECKPOINT, RunDirectory, RunLog
from tests.full_disk import fill, needs_full_device


class State(NamedTuple):
    weights: dict
    pair: tuple


class Other(NamedTuple):
    pair: tuple
    weights: dict


STATE = State(
    {"kernel": jnp.arange(6.0).reshape(2, 3), "bias": jnp.zeros(3)}, (jnp.int32(4), jnp.ones(3))
)


@pytest.fixture
def saved(tmp_path):
    RunDirectory(tmp_path / "out", {"seed": 0}).save(STATE, {"updates": 7})
    return RunDirectory(tmp_path / "out", {"seed": 0}, resume=True)


def test_a_state_comes_back_with_its_leaves_named_by_their_paths(saved):
    state, metadata = saved.load(
        State({"kernel": jnp.zeros((2, 3)), "bias": jnp.ones(3)}, (jnp.int32(0), jnp.zeros(3)))
    )
    np.testing.assert_array_equal(state.weights["kernel"], STATE.weights["kernel"])
    assert int(state.pair[0]) == 4
    assert metadata == {"updates": 7}
    names = set(safetensors.numpy.load_file(saved.folder / CHECKPOINT))
    assert names == {
        "weights.kernel",
        "weights.bias",
        "pair.0",
        "pair.1",
    }


@pytest.mark.parametrize(
    "rest", [b'{"step": 2, "lo', b"\0" * 9, b'\0\0\0"loss": 1.0}\n', b"\xff\n"]
)
def test_a_log_is_read_up_to_what_a_cut_of_power_left(tmp_path, rest):
    (tmp_path / "log.jsonl").write_bytes(b'{"step": 0}\n{"step": 1}\n' + rest)
    assert checkpoint.read_training_log(tmp_path / "log.jsonl") == [{"step": 0}, {"step": 1}]


def test_the_order_of_the_leaves_does_not_matter(saved):
    """Bias and second of the pair have the same shape: by number they would be taken for one
    another."""
    state, _ = saved.load(Other((jnp.int32(0), jnp.zeros(3)), STATE.weights))
    np.testing.assert_array_equal(state.pair[1], jnp.ones(3))
    np.testing.assert_array_equal(state.weights["bias"], jnp.zeros(3))


@pytest.mark.parametrize(
    ("like", "words"),
    [
        (STATE._replace(pair=(jnp.int32(0),)), r"pair.1 was 'float32 \(3,\)' and is None"),
        (
            STATE._replace(pair=(jnp.int32(0), jnp.ones(2))),
            r"was 'float32 \(3,\)' and is 'float32 \(2,\)'",
        ),
        (
            STATE._replace(pair=(jnp.float32(0), jnp.ones(3))),
            r"was 'int32 \(\)' and is 'float32 \(\)'",
        ),
    ],
)
def test_a_leaf_that_does_not_fit_is_named(saved, like, words):
    with pytest.raises(ArtifactError, match=rf"{words}\); start again with --overwrite"):
        saved.load(like)


@pytest.mark.parametrize("name", ["seed 1", "damaged", "other version"])
def test_a_checkpoint_that_cannot_be_resumed_is_refused_and_can_be_discarded(
    tmp_path, saved, monkeypatch, name
):
    fingerprint = {"seed": 1} if name == "seed 1" else {"seed": 0}
    if name == "damaged":
        (saved.folder / CHECKPOINT).write_bytes(b"not a checkpoint")
    if name == "other version":
        monkeypatch.setattr(checkpoint, "software_versions", lambda: "softfin 99.1, jax 99.2")
    with pytest.raises(ArtifactError, match="--overwrite"):
        RunDirectory(tmp_path / "out", fingerprint, resume=True)
    anew = RunDirectory(tmp_path / "out", fingerprint, overwrite=True)
    assert anew.load(STATE) is None


def test_a_checkpoint_that_cannot_be_removed_is_not_taken_for_one_of_the_new_run(tmp_path, saved):
    saved.folder.rename(tmp_path / "disk")
    saved.folder.symlink_to(tmp_path / "disk")
    with pytest.raises(RunError, match=r"\.out\.unfinished: cannot be removed "):
        RunDirectory(tmp_path / "out", {"seed": 0}, overwrite=True)


def test_a_checkpoint_of_another_version_is_refused_and_both_are_named(
    tmp_path, saved, monkeypatch
):
    now = checkpoint.software_versions()
    monkeypatch.setattr(checkpoint, "software_versions", lambda: "softfin 99.1, jax 99.2")
    words = (
        rf"written by {re.escape(now)}, but this is softfin 99.1, jax 99.2; resume with "
        r"that version, or use --overwrite"
    )
    for attempt in (
        lambda: RunDirectory(tmp_path / "out", {"seed": 0}, resume=True),
        lambda: saved.load(STATE),
    ):
        with pytest.raises(ArtifactError, match=words):
            attempt()


@needs_full_device
def test_a_log_on_a_full_disk_raises_an_error(tmp_path):
    log = RunLog(tmp_path)
    log.write(1, loss=0.5)
    fill(log.path)
    message = r"log.jsonl: cannot be written \(No space left on device\); free disk space, then"
    with pytest.raises(RunError, match=message):
        log.write(2, loss=0.5)
