"""The only list of the artifact kinds that softfin writes, with their format numbers.

The number of a kind changes when other versions of softfin cannot read its files; additional keys
do not change it. A file without a number has format 1. Configurations (YAML) have no number,
because their keys are checked by name.
"""

from collections.abc import Mapping
from typing import Any

from softfin.core.errors import ArtifactError, InputError, LogError

FOLDERS: Mapping[str, int] = {
    "dataset": 1,
    "inspection": 1,
    "surrogate": 1,
    "controller": 3,
    "family": 1,
    "evaluation": 2,
    "benchmark": 1,
    "calibration": 1,
    "reproduction": 1,
    "robot": 1,
    "example": 1,
}
"""Formats of folders, keyed by kind; a ``KIND.json`` describes each folder."""

FILES: Mapping[str, int] = {"log": 1, "recording": 1}
"""Formats of single files. Logs (Parquet) store the number in the schema metadata; recordings
(MCAP) store it in the channel metadata."""

FORMATS: Mapping[str, int] = {**FOLDERS, **FILES}
"""Formats of all artifacts, keyed by kind."""

IN_FILE = "softfin_format"
"""Key of the format number in the metadata of single files; the value is a string."""


def check_format(
    kind: str, number: object, source: str, error: type[InputError] = ArtifactError
) -> None:
    """Raise an error of class `error` unless this version reads artifacts of this kind and format
    number."""
    expected = FORMATS[kind]
    if number != expected:
        raise error(
            f"{source}: format is {str(number)[:80]!r}, but this version of softfin reads "
            f"{expected}; use the version that wrote the file, or create the file again"
        )


def check_file_format(
    kind: str, metadata: Mapping[Any, Any] | None, source: str, error: type[InputError] = LogError
) -> None:
    """Check the format number in the metadata of a single file; keys and values are strings or
    bytes."""
    entries = metadata or {}
    found = entries.get(IN_FILE, entries.get(IN_FILE.encode(), "1"))
    text = found.decode(errors="replace") if isinstance(found, bytes) else str(found)
    check_format(kind, int(text) if text.isdecimal() else text, source, error)
