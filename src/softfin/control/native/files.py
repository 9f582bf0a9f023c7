"""A controller's folder as bytes: read once, of bounded size, nothing of it run, nothing written."""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors
import safetensors.numpy

from softfin.control.native.description import LARGEST
from softfin.core.errors import ArtifactError
from softfin.core.files import parse_json, read_bytes
from softfin.storage.artifact import LARGEST_JSON, LARGEST_WEIGHTS, WEIGHTS, find_description

DESCRIPTION = "controller.json"


class Folder(NamedTuple):
    """What was read."""

    description: dict[str, Any]
    arrays: dict[str, np.ndarray]
    """float32, finite, moderate."""
    sha256: str
    """Of the file of weights."""


def read_folder(path: Path) -> Folder:
    """Both files; raises ArtifactError where the folder is no controller, or no longer a whole one."""
    find_description(path, "controller")
    try:
        description = parse_json(_read(path / DESCRIPTION, LARGEST_JSON))
    except ValueError as error:
        raise ArtifactError(f"{path / DESCRIPTION}: not readable as JSON ({_line(error)}); copy it again") from None
    if not isinstance(description, dict):
        raise ArtifactError(f"{path / DESCRIPTION}: holds no object; it was not written by softfin")
    weights = path / WEIGHTS
    if not weights.is_file():
        raise ArtifactError(f"{weights}: missing; copy the whole folder again")
    data = _read(weights, LARGEST_WEIGHTS)
    try:
        arrays = safetensors.numpy.load(data)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ArtifactError(f"{weights}: truncated or damaged ({_line(error)}); copy it again") from None
    return Folder(
        description,
        {name: _checked(array, name, weights) for name, array in arrays.items()},
        hashlib.sha256(data).hexdigest(),
    )


def _read(file: Path, largest: int) -> bytes:
    try:
        return read_bytes(file, largest)
    except OSError as error:
        raise ArtifactError(f"{file}: cannot be read ({error.strerror or error}); copy it again") from None


def _checked(array: np.ndarray, name: str, source: Path) -> np.ndarray:
    name = name[:80]
    if array.dtype.kind != "f":
        raise ArtifactError(f"{source}: {name!r} is of type {array.dtype}; weights are float32; copy it again")
    # Not a number is not at most anything.
    if not (np.abs(array) <= LARGEST).all():
        raise ArtifactError(
            f"{source}: {name!r} holds numbers that are not finite or beyond {LARGEST:g}; copy it again"
        )
    return np.array(array, np.float32, order="C")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
