"""Folders on disk that describe themselves: a JSON beside ``weights.safetensors``, written whole or not at all.

A folder is written beside its place and renamed into it, so a crash leaves the old one or the new one. No pickle.
"""

import contextlib
import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from softfin.errors import ArtifactError, RunError

Weights = Mapping[str, NDArray[Any]]

WEIGHTS = "weights.safetensors"

KINDS = (
    "dataset", "surrogate", "controller", "controllers", "evaluation", "reproduction", "calibration", "comparison",
    "inspection", "map", "baselines",
)  # fmt: skip
"""Of folders, each told by its ``KIND.json``."""


def check_vacant(path: Path, overwrite: bool = False) -> None:
    """Raise unless a folder may be written at `path`: vacant, or a softfin folder and `overwrite`."""
    recover(path)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not overwrite:
        raise ArtifactError(f"{path}: exists already; give another --out, or --overwrite to replace it")
    if not path.is_dir() or not any(is_kind(path, kind) for kind in KINDS):
        raise ArtifactError(f"{path}: exists and is no folder of softfin's, so it is not replaced; give another --out")


def is_kind(path: Path, kind: str) -> bool:
    """Whether `path` holds a ``KIND.json``."""
    return (path / f"{kind}.json").is_file()


def write_folder(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a folder beside `path`, then rename it into place, replacing what was there."""
    path = path.absolute()
    recover(path)
    beside, old = path.with_name(f".{path.name}.partial"), _old(path)
    try:
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        write(beside)
        if path.exists():
            path.rename(old)
        beside.rename(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror or error}); what was there is left") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        recover(path)
        shutil.rmtree(old, ignore_errors=True)


def recover(path: Path) -> None:
    """Put back a folder that a kill left between the two renames of `write_folder`."""
    if not path.exists() and _old(path).exists():
        _old(path).rename(path)


def _old(path: Path) -> Path:
    return path.absolute().with_name(f".{path.name}.old")


def write_file(path: Path, data: bytes | str) -> None:
    """Write a file beside its place and rename it into it."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        # Never through a link that somebody put there.
        with beside.open("xb") as file:
            file.write(data if isinstance(data, bytes) else data.encode())
        beside.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink()


def save(
    path: Path,
    kind: str,
    description: Mapping[str, Any],
    weights: Weights,
    also: Callable[[Path], None] | None = None,
) -> None:
    """Write ``KIND.json``, the weights and what `also` adds as one folder."""

    def write(folder: Path) -> None:
        # Bytes through Path: safetensors' own writer hides a full disk, and makes files that others cannot read.
        (folder / WEIGHTS).write_bytes(encode(weights))
        (folder / f"{kind}.json").write_text(dump_json(description))
        if also is not None:
            also(folder)

    write_folder(path, write)


def encode(weights: Weights, metadata: dict[str, str] | None = None) -> bytes:
    """Arrays by name as safetensors."""
    return safetensors.numpy.save({name: np.asarray(array, order="C") for name, array in weights.items()}, metadata)


def load(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The description and the weights of a folder that `save` wrote; raises ArtifactError for anything else."""
    description = load_description(path, kind)
    try:
        weights = safetensors.numpy.load_file(path / WEIGHTS)
    except FileNotFoundError:
        raise ArtifactError(f"{path / WEIGHTS}: missing; copy the whole folder again") from None
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise ArtifactError(f"{path / WEIGHTS}: truncated or damaged ({error}); copy it again") from None
    return description, weights


def load_description(path: Path, kind: str) -> dict[str, Any]:
    """The JSON of a folder of one kind: dataset, surrogate, controller."""
    recover(path)
    file = path / f"{kind}.json"
    if not path.is_dir():
        raise ArtifactError(f"{path}: no such folder; it should be a {kind}, a folder with a {kind}.json")
    if not file.is_file():
        raise ArtifactError(f"{path}: not a {kind}: it holds no {kind}.json")
    return read_json(file)


def read_json(file: Path) -> dict[str, Any]:
    """The object in a JSON file of softfin's."""
    try:
        description = json.loads(file.read_text())
    except (ValueError, OSError, RecursionError) as error:
        raise ArtifactError(f"{file}: not readable as JSON ({error}); copy it again") from None
    if not isinstance(description, dict):
        raise ArtifactError(f"{file}: holds no object; it was not written by softfin")
    return description


def dump_json(value: Any) -> str:
    """Indented JSON with a final newline, of what `plain` makes of a value."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """What JSON can say of a value: arrays as lists, numbers that are not finite as null, anything unknown as text.

    JSON has no infinity and no NaN, and a result must not be lost because one number in it is missing.
    """
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return plain(value.tolist()) if hasattr(value, "tolist") else str(value)


def provenance(**facts: Any) -> dict[str, Any]:
    """Where an artifact comes from: the given facts, versions, git commit, time."""
    return {
        **facts,
        "softfin": importlib.metadata.version("softfin"),
        "jax": _version("jax"),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "git_commit": _git_commit(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _version(package: str) -> str | None:
    """None on a computer that runs controllers without it."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Of the checkout that softfin runs from, with ``+`` when it has uncommitted changes; None outside one."""

    def git(*words: str) -> str:
        run = subprocess.run(
            ["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=5
        )
        return run.stdout.strip()

    try:
        # An environment inside somebody's repository is no checkout of softfin.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*") or None
    except (OSError, subprocess.SubprocessError):
        return None
