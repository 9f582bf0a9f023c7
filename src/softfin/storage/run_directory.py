"""Unfinished work: a folder ``.NAME.unfinished`` next to the output, with the last checkpoint and
the training log.

A checkpoint is a safetensors file that contains a pytree of arrays, named by their paths, and
metadata as JSON, including software versions. A checkpoint is replaced by a rename, so a process
killed at any time leaves either the old or the new checkpoint.
"""

import importlib.metadata
import json
import shutil
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
"""Subfolder of a finished artifact with ``log.jsonl`` and a description of the run."""
RUN = "run.json"
LOG = "log.jsonl"
FIX = "free disk space, then use --resume"
"""Suggested fix if a file of an unfinished run cannot be written."""


class RunDirectory:
    """The unfinished work for one output folder."""

    def __init__(
        self, out: Path, fingerprint: JsonObject, resume: bool = False, overwrite: bool = False
    ) -> None:
        """Claim ``.NAME.unfinished`` next to `out`; continue the work in it with `resume`, or
        discard it with `overwrite`. A fingerprint of configuration, data and seed identifies a run.

        Raises ArtifactError if there is unfinished work and neither flag is set, or if `resume` is
        set and the unfinished or finished work belongs to a different run.
        """
        # Next to the output lock, even if the output is reached through a link.
        self.folder = out.resolve().with_name(f".{out.resolve().name}.unfinished")
        self.fingerprint = json.loads(artifacts.dump_json(fingerprint))
        # With `resume`, a run with a finished artifact needs no further work.
        finished = out / TRAINING_LOG / RUN
        self.complete = resume and not overwrite and finished.is_file()
        """Whether `out` already contains the finished artifact of this run."""
        if self.complete:
            check_same(out, artifacts.read_json(finished), self.fingerprint)
            return
        artifacts.check_vacant(out, overwrite)
        checkpoint = self.folder / CHECKPOINT
        if resume:
            if checkpoint.exists():
                self._read(checkpoint)
            return
        if checkpoint.exists() and not overwrite:
            raise ArtifactError(
                f"{self.folder}: contains an unfinished run; continue with --resume, or discard it "
                "with --overwrite"
            )
        try:
            if self.folder.exists():
                shutil.rmtree(self.folder)
        except OSError as error:
            # Otherwise, its checkpoint could be mistaken for a checkpoint of this run.
            raise RunError(
                f"{self.folder}: cannot be removed ({error.strerror or error}); remove it yourself"
            ) from None

    def save(self, tree: PyTree, metadata: JsonObject) -> None:
        """Replace the checkpoint."""
        run = {"software": software_versions(), "fingerprint": self.fingerprint}
        artifacts.write_file(
            self.folder / CHECKPOINT,
            artifacts.encode(name_leaves(tree), {"facts": json.dumps(run | metadata)}),
            FIX,
        )

    def load(self, like: Tree) -> tuple[Tree, JsonObject] | None:
        """Return the last checkpoint with the structure of `like`; None if there is no checkpoint
        yet. Raises ArtifactError if the checkpoint has a different structure."""
        path = self.folder / CHECKPOINT
        if not path.exists():
            return None
        arrays, metadata = self._read(path)
        expected = name_leaves(like)
        # Leaves are matched by name, because leaves of the same shape could otherwise be swapped.
        check_same(path, _describe(arrays), _describe(expected), "start again with --overwrite")
        leaves = [jnp.asarray(arrays[name]) for name in expected]
        return jax.tree.unflatten(jax.tree.structure(like), leaves), metadata

    def _read(self, path: Path) -> tuple[dict[str, np.ndarray], JsonObject]:
        """Read the arrays and the metadata of a checkpoint, which must belong to this run."""
        try:
            with safetensors.safe_open(path, "numpy") as file:
                arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                metadata: JsonObject = json.loads(file.metadata()["facts"])
            fingerprint = metadata.pop("fingerprint")
            software = metadata.pop("software")
        except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
            raise ArtifactError(
                f"{path}: damaged ({error}); start again with --overwrite"
            ) from None
        # The training state and the random numbers depend on both versions.
        current = software_versions()
        if software != current:
            raise ArtifactError(
                f"{path}: written by {software}, but this is {current}; resume with that version, "
                "or use --overwrite"
            )
        check_same(path, fingerprint, self.fingerprint)
        return arrays, metadata

    def log(self, rewind_to: int | None = None) -> "RunLog":
        """Open the training log. When a run resumes, entries after step `rewind_to` are dropped
        because they will be written again."""
        return RunLog(self.folder, rewind_to)

    def keep_log(self, artifact: Path) -> None:
        """Copy the training log to a finished artifact, together with the fingerprint of the
        run."""
        folder = artifact / TRAINING_LOG
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RUN).write_text(artifacts.dump_json(self.fingerprint))
        if (self.folder / LOG).exists():
            shutil.copy(self.folder / LOG, folder)

    def finish(self) -> None:
        """Remove the folder once the artifact is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)


class RunLog:
    """Scalars of a run: one line of JSON per step."""

    def __init__(self, folder: Path, rewind_to: int | None = None) -> None:
        self.path = folder / LOG
        # If there is no step to rewind to, the run starts from the beginning, so discard all old
        # entries.
        last = -1 if rewind_to is None else rewind_to
        kept = [entry for entry in read_training_log(self.path) if entry["step"] <= last]
        artifacts.write_file(self.path, "".join(json.dumps(entry) + "\n" for entry in kept), FIX)

    def write(self, step: int, **scalars: float) -> None:
        """Append the scalars of one step; non-finite values become null.

        Raises RunError if the file cannot be written, for example because the disk is full.
        """
        numbers = {name: float(value) for name, value in scalars.items()}
        entry = json.dumps(artifacts.plain({"step": step, **numbers}), allow_nan=False)
        try:
            with self.path.open("a") as file:
                file.write(entry + "\n")
        except OSError as error:
            raise RunError(f"{self.path}: cannot be written ({error.strerror}); {FIX}") from None


def read_training_log(path: Path) -> list[JsonObject]:
    """Return the entries of a ``log.jsonl`` up to the first line damaged by a crash or a power
    cut."""
    entries = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            entries.append(json.loads(line))
        except ValueError:
            break
    return entries


def software_versions() -> str:
    """Return the software versions on which a run depends."""
    return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("softfin", "jax"))


def _describe(leaves: Mapping[str, object]) -> dict[str, str]:
    """Return the type and shape of each leaf."""
    arrays = {name: np.asarray(leaf) for name, leaf in leaves.items()}
    return {name: f"{array.dtype} {array.shape}" for name, array in arrays.items()}


def check_same(
    path: Path,
    before: object,
    now: object,
    remedy: str = "use the same options, choose a different --out, or use --overwrite",
) -> None:
    """Raise ArtifactError unless the run at a path is the same as the current run; both are
    described by nested mappings."""
    if before != now:
        changes = describe_changes(name_leaves(before), name_leaves(now))
        raise ArtifactError(f"{path}: belongs to a different run ({changes}); {remedy}")


def name_path(path: tuple[Hashable, ...]) -> str:
    """Return the name of a pytree leaf, such as ``posnet.3.kernel``."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def name_leaves(tree: PyTree) -> dict[str, object]:
    """Return the leaves of a pytree by their names, in the order of the structure."""
    return {name_path(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}
