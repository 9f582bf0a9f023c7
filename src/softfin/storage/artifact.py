"""Self-describing folders: a JSON file next to ``weights.safetensors``, written completely or not
at all.

A folder is written next to its destination and then renamed. An existing folder is kept until the
new one replaces it. Reading never writes, and pickle is never used. NumPy and safetensors are
imported only to read or write weights; the command line inspects folders without them.
"""

import contextlib
import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, TypedDict

from softfin.core.errors import ArtifactError, RunError
from softfin.core.json_object import JsonObject
from softfin.storage.formats import FOLDERS, check_format

WEIGHTS = "weights.safetensors"


def check_vacant(
    path: Path, overwrite: bool = False, option: str = "--out", kind: str | None = None
) -> None:
    """Raise ArtifactError unless a folder can be written to `path`: it must be missing or empty, or
    a softfin folder if `overwrite` is set, of the given kind if there is one."""
    try:
        is_current = Path.cwd().is_relative_to(path.resolve())
    except FileNotFoundError:
        # The current folder was deleted.
        is_current = False
    if is_current:
        # The output replaces the folder, and relative paths would no longer refer to anything.
        raise ArtifactError(
            f"{path}: is or contains the current folder, which cannot be replaced; choose a "
            f"different {option}"
        )
    check_writable(path, option)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not overwrite:
        raise ArtifactError(
            f"{path}: already exists; choose a different {option}, or use --overwrite to replace it"
        )
    kinds = tuple(FOLDERS) if kind is None else (kind,)
    if not any(_is_own(path, each) for each in kinds):
        raise ArtifactError(
            f"{path}: already exists and is not a softfin {kind or 'folder'}, so it is not "
            f"replaced; choose a different {option}"
        )


def check_file(path: Path, overwrite: bool, option: str = "--out") -> None:
    """Raise ArtifactError unless a file can be written to `path`, the value of `option`."""
    if path.exists() and not path.is_file():
        raise ArtifactError(
            f"{path}: already exists and is not a file; choose a different {option}"
        )
    if path.exists() and not overwrite:
        raise ArtifactError(
            f"{path}: already exists; choose a different {option}, or use --overwrite to replace it"
        )
    check_writable(path, option)


def check_writable(path: Path, option: str = "--out") -> None:
    """Raise ArtifactError unless a file or folder can be created at `path`. The function tests this
    by creating a file, because permissions are not the only obstacle."""
    # The nearest existing parent decides whether the missing folders can be created.
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    try:
        Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=parent)).rmdir()
    except OSError as error:
        raise ArtifactError(
            f"{path}: cannot be written ({parent}: {error.strerror}); choose a different {option}"
        ) from None


def is_kind(path: Path, kind: str) -> bool:
    """Return whether the folder `path` contains a ``KIND.json``."""
    return (path / f"{kind}.json").is_file()


def _is_own(path: Path, kind: str) -> bool:
    """Return whether softfin wrote this folder; other programs may also write files such as
    ``robot.json``."""
    with contextlib.suppress(ArtifactError):
        return read_json(path / f"{kind}.json").get("kind") == kind
    return False


def write_folder(path: Path, write: Callable[[Path], None], overwrite: bool = False) -> None:
    """Let `write` fill a folder next to `path`, then rename it to `path`; `overwrite` replaces an
    existing folder.

    Raises ArtifactError if `path` must not be written, and RunError if filling or renaming fails.
    If renaming fails, the filled folder is kept, and the message contains its path.
    """
    check_vacant(path, overwrite)
    path = path.resolve()
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    before = beside.with_suffix(".before")
    try:
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        write(beside)
    except BaseException as error:
        shutil.rmtree(beside, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise RunError(
            f"{path}: cannot be written ({error.strerror or error}); nothing else was changed"
        ) from None
    try:
        # Another process may have written `path` during the computation, so check again.
        check_vacant(path, overwrite)
        if path.exists():
            path.rename(before)
        beside.rename(path)
    except (OSError, ArtifactError) as error:
        if before.exists() and not path.exists():
            with contextlib.suppress(OSError):
                before.rename(path)
        # The result may have taken hours, so it is kept.
        raise RunError(f"{error}; the finished result is in {beside}; rename it") from None
    shutil.rmtree(before, ignore_errors=True)


def sync(place: Path) -> None:
    """Flush a file or folder to disk so that a power cut cannot leave a file without contents."""
    descriptor = os.open(place, os.O_RDONLY)
    try:
        # Some file systems cannot flush folders and do not need to.
        with contextlib.suppress(OSError) if place.is_dir() else contextlib.nullcontext():
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_file(
    path: Path,
    data: bytes | str | Callable[[BinaryIO], None],
    fix: str = "free disk space, or choose a different path",
) -> None:
    """Write a file next to its destination and rename it once it is on disk; `data` may be a
    function that writes in pieces. If writing fails, the error message ends with `fix`."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)
        # Exclusive creation: never write through a link that another user placed there.
        with beside.open("xb") as file:
            if callable(data):
                data(file)
            else:
                file.write(data if isinstance(data, bytes) else data.encode())
        sync(beside)
        beside.replace(path)
        sync(path.parent)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror or error}); {fix}") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink()


def save(
    path: Path,
    kind: str,
    description: Mapping[str, object],
    weights: Mapping[str, object],
    extra_files: Callable[[Path], None] | None = None,
    overwrite: bool = False,
) -> None:
    """Write ``KIND.json``, the weights and the files of `extra_files` as one folder, using
    `write_folder`."""

    def write(folder: Path) -> None:
        # The bytes are written by Path because the writer of safetensors does not report a full
        # disk and creates files that other users cannot read.
        (folder / WEIGHTS).write_bytes(encode(weights))
        write_description(folder, kind, description)
        if extra_files is not None:
            extra_files(folder)

    write_folder(path, write, overwrite)


class Head(TypedDict):
    """First entries of a description."""

    kind: str
    format: int


def head(kind: str) -> Head:
    """Return the first entries of a description."""
    return {"kind": kind, "format": FOLDERS[kind]}


def write_description(folder: Path, kind: str, description: Mapping[str, object]) -> None:
    """Write ``KIND.json`` to a folder."""
    (folder / f"{kind}.json").write_text(encode_description(kind, description))


def encode_description(kind: str, description: Mapping[str, object]) -> str:
    """Return a description as JSON that starts with the kind and format number."""
    return dump_json({**head(kind), **description})


def encode(weights: Mapping[str, object], metadata: dict[str, str] | None = None) -> bytes:
    """Encode named arrays as safetensors."""
    import numpy as np
    import safetensors.numpy

    return safetensors.numpy.save(
        {name: np.asarray(array, order="C") for name, array in weights.items()}, metadata
    )


def load(path: Path, kind: str) -> tuple[JsonObject, dict[str, Any]]:
    """Read the description and the weights from a folder written by `save`; raises ArtifactError if
    it is anything else."""
    import safetensors.numpy

    description = load_description(path, kind)
    file = path / WEIGHTS
    if not file.exists():
        raise ArtifactError(f"{file}: missing; copy the complete folder again")
    try:
        weights = safetensors.numpy.load_file(file)
        for name, array in weights.items():
            # Only floating-point numbers and signed or unsigned integers are allowed.
            if array.dtype.kind not in "fiu":
                raise ValueError(f"{name[:80]!r} is of type {array.dtype}")
    except Exception as error:
        # safetensors raises various errors for damaged files and for types that NumPy lacks, such
        # as bfloat16.
        raise ArtifactError(f"{file}: truncated or damaged ({error}); copy it again") from None
    return description, weights


def load_description(path: Path, kind: str) -> JsonObject:
    """Read the JSON file of a folder of the given kind; raises ArtifactError if `path` is anything
    else or this version cannot read the format."""
    file = find_description(path, kind)
    description = read_json(file)
    check_format(kind, description.get("format", 1), str(file))
    return description


def find_description(path: Path, kind: str) -> Path:
    """Return the description file of a folder of the given kind; raises ArtifactError if `path` is
    anything else."""
    file = path / f"{kind}.json"
    if not path.is_dir():
        raise ArtifactError(
            f"{path}: no such folder; it must be a {kind}: a folder with a {kind}.json"
        )
    if not file.is_file():
        raise ArtifactError(f"{path}: not a {kind}: it contains no {kind}.json")
    return file


def read_json(file: Path, remedy: str = "copy it again") -> JsonObject:
    """Read the object from one of softfin's JSON files."""
    try:
        description = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise ArtifactError(f"{file}: cannot be read as JSON ({error}); {remedy}") from None
    if not isinstance(description, dict):
        raise ArtifactError(f"{file}: must contain a JSON object; it was not written by softfin")
    return description


def dump_json(value: object) -> str:
    """Return a value, converted with `plain`, as indented JSON with a final newline."""
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


def plain(value: object) -> Any:
    """Convert a value for JSON: arrays become lists, non-finite numbers become null, and unknown
    objects become strings."""
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return plain(value.tolist()) if hasattr(value, "tolist") else str(value)


def provenance(**metadata: object) -> JsonObject:
    """Return the provenance of an artifact: the given metadata, software versions, git commit and
    time."""
    versions: dict[str, str | None] = dict.fromkeys(("softfin", "jax", "numpy"))
    for package in versions:
        # JAX may be missing, because controllers also run on computers without it.
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        **metadata,
        **versions,
        "python": platform.python_version(),
        "git_commit": _git_commit(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _git_commit() -> str | None:
    """Return the commit of softfin's checkout, with ``+`` if there are uncommitted changes; None
    outside a checkout."""
    checkout = Path(__file__).parents[3]
    # An environment inside a different repository is not a checkout of softfin.
    if not (checkout / ".git").exists():
        return None
    command = ("git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*")
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        output = subprocess.check_output(
            command, cwd=checkout, stderr=subprocess.DEVNULL, text=True, timeout=5
        )
        return output.strip() or None
    return None
