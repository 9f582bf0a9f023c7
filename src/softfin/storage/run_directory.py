"""Work in progress, next to its output: a folder ``.NAME.unfinished`` with the last checkpoint and
the training log.

A checkpoint is a safetensors file: a pytree of arrays, named by their paths, and metadata as JSON,
including the versions that wrote it. It is replaced by a rename, so a process killed at any time
leaves either the old or the new checkpoint.
"""

import importlib.metadata
import json
import shutil
import socket
import struct
import time
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
from jaxtyping import PyTree

from softfin.core.errors import ArtifactError, RunError
from softfin.core.json_object import JsonObject, describe_changes
from softfin.storage import artifact as artifacts

Tree = TypeVar("Tree")

CHECKPOINT = "checkpoint.safetensors"
TRAINING_LOG = "training"
"""Subfolder of a finished artifact with ``log.jsonl``, the TensorBoard event file, and a
description of the run that wrote them."""
RUN = "run.json"
LOG = "log.jsonl"
FIX = "free disk space, then use --resume"
"""Fix in the error message if a file of an unfinished run cannot be written."""


class RunDirectory:
    """The unfinished work for one output folder."""

    def __init__(
        self, out: Path, fingerprint: JsonObject, resume: bool = False, overwrite: bool = False
    ) -> None:
        """Claim ``.NAME.unfinished`` next to `out`: continue it with `resume`, empty it with
        `overwrite`.

        With both, the folder is continued if its checkpoints are intact and belong to the same run,
        and emptied otherwise. The fingerprint of configuration, data and seed identifies a run.
        Raises ArtifactError if there is unfinished work and neither flag is set, or if it belongs
        to another run and must not be overwritten.
        """
        self.overwrite = overwrite
        # Next to the lock of the output, whatever the name by which it is reached.
        self.folder = out.resolve().with_name(f".{out.resolve().name}.unfinished")
        self.fingerprint = json.loads(artifacts.dump_json(fingerprint))
        # With `resume`, a run whose artifact is already finished needs no further work.
        finished = out / TRAINING_LOG / RUN
        self.complete = resume and not overwrite and finished.is_file()
        """Whether `out` already contains the finished artifact of this run."""
        if self.complete:
            check_same(out, artifacts.read_json(finished), self.fingerprint)
            return
        artifacts.check_vacant(out, overwrite)
        checkpoint = self.folder / CHECKPOINT
        if resume:
            try:
                if checkpoint.exists():
                    self._read(checkpoint)
            except ArtifactError:
                if not overwrite:
                    raise
                shutil.rmtree(self.folder)
        elif self.folder.exists():
            if not overwrite and checkpoint.exists():
                raise ArtifactError(
                    f"{self.folder}: contains an unfinished run; continue with --resume, or "
                    "discard it with --overwrite"
                )
            shutil.rmtree(self.folder)

    def save(self, tree: PyTree, metadata: JsonObject) -> None:
        """Replace the checkpoint."""
        whole = json.dumps({"software": _software(), "fingerprint": self.fingerprint, **metadata})
        artifacts.write_file(
            self.folder / CHECKPOINT, artifacts.encode(_named(tree)[0], {"facts": whole}), FIX
        )

    def load(self, like: Tree) -> tuple[Tree, JsonObject] | None:
        """Return the last checkpoint, with the structure of `like`; None if there is none yet.

        A checkpoint that does not match raises ArtifactError, or is treated as absent if it may be
        overwritten.
        """
        path = self.folder / CHECKPOINT
        if not path.exists():
            return None
        arrays, metadata = self._read(path)
        expected, structure = _named(like)
        # Compare both ways, so that missing and additional leaves are found as well.
        for name in sorted(arrays | expected):
            there = _describe_leaf(arrays, name)
            here = _describe_leaf(expected, name)
            if there != here:
                if self.overwrite:
                    return None
                raise ArtifactError(
                    f"{path}: does not match this training state ({name} is {there} in the "
                    f"checkpoint, {here} in this run); start again with --overwrite"
                )
        leaves = [jnp.asarray(arrays[name]) for name in expected]
        return jax.tree.unflatten(structure, leaves), metadata

    def _read(self, path: Path) -> tuple[dict[str, np.ndarray], JsonObject]:
        """Read the arrays and the metadata of a checkpoint, which must belong to this run."""
        try:
            with safetensors.safe_open(path, "numpy") as file:
                arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                metadata: JsonObject = json.loads(file.metadata()["facts"])
        except (
            OSError,
            KeyError,
            TypeError,
            ValueError,
            AttributeError,
            safetensors.SafetensorError,
        ) as error:
            raise ArtifactError(
                f"{path}: damaged ({error}); start again with --overwrite"
            ) from None
        before = metadata.pop("fingerprint", {})
        software = metadata.pop("software", "an older softfin")
        if software != _software():
            raise ArtifactError(
                f"{path}: written by {software}, but this is {_software()}; resume with that "
                "version, or use --overwrite"
            )
        check_same(path, before, self.fingerprint)
        return arrays, metadata

    def log(self, rewind_to: int | None = None) -> "RunLog":
        """Open the training log. When a run resumes, entries after step `rewind_to` are dropped,
        because they will be written again."""
        return RunLog(self.folder, rewind_to)

    def keep_log(self, artifact: Path) -> None:
        """Copy the training log to a finished artifact, with the run's fingerprint."""
        folder = artifact / TRAINING_LOG
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RUN).write_text(artifacts.dump_json(self.fingerprint))
        for file in (*self.folder.glob(LOG), *self.folder.glob("events.*")):
            shutil.copy(file, folder)

    def finish(self) -> None:
        """Remove the folder once the artifact is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)


class RunLog:
    """Scalars of a run: one line of JSON per step, and an event file for TensorBoard.

    The calling thread writes both files, so a full disk stops the run with an error. tensorboardX
    would write from its own thread. If a write fails, this thread ends without a message, its queue
    fills, and the run waits forever.
    """

    def __init__(self, folder: Path, rewind_to: int | None = None) -> None:
        self.path = folder / LOG
        # Without a step to rewind to, the run starts from the beginning, so discard all old
        # entries.
        last = -1 if rewind_to is None else rewind_to
        kept = [entry for entry in read_training_log(self.path) if entry["step"] <= last]
        artifacts.write_file(self.path, "".join(json.dumps(entry) + "\n" for entry in kept), FIX)
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.softfin"
        self.event_path = folder / name
        self._append_event(file_version="brain.Event:2")
        # This makes TensorBoard discard this step and later steps from earlier event files.
        self._append_event(step=last + 1, session_log={"status": "START"})

    def write(self, step: int, **scalars: float) -> None:
        """Append the scalars of one step; ``log.jsonl`` contains null for non-finite values.

        Raises RunError if the files cannot be written, for example because the disk is full.
        """
        numbers = {name: float(value) for name, value in scalars.items()}
        entry = artifacts.plain({"step": step, **numbers})
        _append(self.path, (json.dumps(entry, allow_nan=False) + "\n").encode())
        values = [{"tag": name, "simple_value": value} for name, value in numbers.items()]
        self._append_event(step=step, summary={"value": values})

    def _append_event(self, **fields: object) -> None:
        # Imported here, because importing protobuf takes a third of a second.
        from tensorboardX.proto.event_pb2 import Event

        event = Event(wall_time=time.time(), **fields)
        _append(self.event_path, _tf_record(event.SerializeToString()))


def _append(path: Path, data: bytes) -> None:
    try:
        with path.open("ab") as file:
            file.write(data)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); {FIX}") from None


def _tf_record(data: bytes) -> bytes:
    """Return a record of TensorBoard's file format: the length and the data, each followed by its
    masked CRC-32C."""
    from tensorboardX.record_writer import masked_crc32c

    parts = (struct.pack("<Q", len(data)), data)
    return b"".join(part + struct.pack("<I", masked_crc32c(part)) for part in parts)


def read_training_log(path: Path) -> list[JsonObject]:
    """Return the entries of a ``log.jsonl``, up to the first line damaged by a crash or a power
    cut."""
    entries = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            entries.append(json.loads(line))
        except ValueError:
            break
    return entries


def _software() -> str:
    """Return the versions on which the training state and the next random numbers depend."""
    return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("softfin", "jax"))


def _named(tree: PyTree) -> tuple[dict[str, object], jax.tree_util.PyTreeDef]:
    """Return the leaves by their paths, such as ``tree.lanes.policy.net.lstm.kernel``, in the order
    of the structure."""
    paths, structure = jax.tree_util.tree_flatten_with_path(tree)
    return {f"tree{jax.tree_util.keystr(path)}": leaf for path, leaf in paths}, structure


def _describe_leaf(leaves: Mapping[str, object], name: str) -> str:
    """Return dtype and shape."""
    if name not in leaves:
        return "missing"
    array = np.asarray(leaves[name])
    return f"{array.dtype} {array.shape}"


def check_same(
    path: Path,
    before: object,
    now: object,
    remedy: str = "use the same options, choose another --out, or use --overwrite",
) -> None:
    """Raise ArtifactError unless the run at a path is the current one; nested mappings describe
    both."""
    if before != now:
        changes = describe_changes(name_leaves(before), name_leaves(now))
        raise ArtifactError(f"{path}: belongs to another run ({changes}); {remedy}")


def name_path(path: tuple[Hashable, ...]) -> str:
    """Return the name of a pytree leaf, such as ``posnet.3.kernel``."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def name_leaves(tree: PyTree) -> dict[str, object]:
    """Return the leaves of a pytree by their names."""
    return {name_path(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}
