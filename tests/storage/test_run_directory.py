"""Checkpoints: leaves by name, strictly, and only those of the software that reads them."""

import re
import struct
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.record_writer import RecordWriter

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
    leaves = ("weights['kernel']", "weights['bias']", "pair[0]", "pair[1]")
    assert names == {f"tree.{leaf}" for leaf in leaves}


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
    ("pair", "leaf", "kept", "given"),
    [
        ((jnp.int32(0),), 1, "float32 (3,)", "missing"),
        ((*STATE.pair, jnp.ones(1)), 2, "missing", "float32 (1,)"),
        ((jnp.int32(0), jnp.ones(2)), 1, "float32 (3,)", "float32 (2,)"),
        ((jnp.float32(0), jnp.ones(3)), 0, "int32 ()", "float32 ()"),
    ],
)
def test_a_leaf_that_does_not_fit_is_named(saved, pair, leaf, kept, given):
    words = f"tree.pair[{leaf}] is {kept} in the checkpoint, {given} in this run"
    with pytest.raises(ArtifactError, match=re.escape(words)):
        saved.load(STATE._replace(pair=pair))


def test_with_resume_and_overwrite_the_run_goes_on_if_it_can(tmp_path, saved):
    state, metadata = RunDirectory(tmp_path / "out", {"seed": 0}, resume=True, overwrite=True).load(
        STATE
    )
    np.testing.assert_array_equal(state.weights["kernel"], STATE.weights["kernel"])
    assert metadata == {"updates": 7}


@pytest.mark.parametrize("name", ["seed 1", "damaged", "other version"])
def test_with_resume_and_overwrite_a_checkpoint_that_cannot_be_resumed_is_dropped(
    tmp_path, saved, monkeypatch, name
):
    fingerprint = {"seed": 1} if name == "seed 1" else {"seed": 0}
    if name == "damaged":
        (saved.folder / CHECKPOINT).write_bytes(b"not a checkpoint")
    if name == "other version":
        monkeypatch.setattr(checkpoint, "_software", lambda: "softfin 99.1, jax 99.2")
    with pytest.raises(ArtifactError, match="--overwrite"):
        RunDirectory(tmp_path / "out", fingerprint, resume=True)
    anew = RunDirectory(tmp_path / "out", fingerprint, resume=True, overwrite=True)
    assert anew.load(STATE) is None


def test_with_resume_and_overwrite_a_checkpoint_that_does_not_fit_is_dropped(tmp_path, saved):
    both = RunDirectory(tmp_path / "out", {"seed": 0}, resume=True, overwrite=True)
    assert both.load(STATE._replace(pair=(jnp.int32(0),))) is None


def test_a_checkpoint_of_another_version_is_refused_and_both_are_named(
    tmp_path, saved, monkeypatch
):
    now = checkpoint._software()
    monkeypatch.setattr(checkpoint, "_software", lambda: "softfin 99.1, jax 99.2")
    words = rf"{re.escape(now)}, .* softfin 99\.1, jax 99\.2; .* --overwrite"
    with pytest.raises(ArtifactError, match=words):
        RunDirectory(tmp_path / "out", {"seed": 0}, resume=True)
    with pytest.raises(ArtifactError, match=words):
        saved.load(STATE)


def test_one_of_before_versions_were_kept_is_refused(tmp_path, saved):
    weights = {"0": np.zeros(3, np.float32)}
    data = safetensors.numpy.save(weights, {"facts": '{"fingerprint": {"seed": 0}}'})
    (saved.folder / CHECKPOINT).write_bytes(data)
    with pytest.raises(ArtifactError, match="older softfin"):
        saved.load(STATE)


@needs_full_device
@pytest.mark.parametrize("pattern", ["log.jsonl", "events.*"])
def test_a_log_on_a_full_disk_raises_an_error(tmp_path, pattern):
    log = RunLog(tmp_path)
    log.write(1, loss=0.5)
    (file,) = tmp_path.glob(pattern)
    fill(file)
    with pytest.raises(RunError, match=rf"{file.name}: .*No space left on device"):
        log.write(2, loss=0.5)


def test_the_event_file_is_the_one_that_tensorboardx_would_write(tmp_path):
    log = RunLog(tmp_path, rewind_to=4)
    log.write(5, **{"seed0/reward": 0.5, "seed0/loss": float("nan")})
    (file,) = tmp_path.glob("events.out.tfevents.*.softfin")
    content = file.read_bytes()
    events = []
    position = 0
    while position < len(content):
        (length,) = struct.unpack_from("<Q", content, position)
        # After the length and its checksum.
        start = position + 12
        events.append(Event.FromString(content[start : start + length]))
        position = start + length + 4
    version, restart, scalars = events
    assert version.file_version == "brain.Event:2"
    assert (restart.step, restart.session_log.status) == (5, SessionLog.START)
    assert scalars.step == 5
    reward, loss = scalars.summary.value
    assert (reward.tag, reward.simple_value) == ("seed0/reward", 0.5)
    assert loss.tag == "seed0/loss"
    assert np.isnan(loss.simple_value)
    writer = RecordWriter(str(tmp_path / "expected"))
    for event in events:
        writer.write(event.SerializeToString())
    writer.close()
    assert content == (tmp_path / "expected").read_bytes()
