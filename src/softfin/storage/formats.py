"""Every kind of artifact that softfin writes, with its format number. This is the only such list.

A kind's number increases when older versions of softfin cannot read the new files. `oldest` then
stays unchanged, the reader of the older format is kept, and ``tests/golden`` gets a file in the new
format. Added keys do not change the number. A file without a number has format 1. Configurations
(YAML) have no number: their keys are checked by name.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from softfin.core.errors import ArtifactError, InputError, LogError


class Format(NamedTuple):
    """Format number of one kind of artifact, and the formats that this version of softfin reads."""

    number: int = 1
    """Format that this version writes, and the newest that it reads."""
    oldest: int = 1
    """Oldest format that this version reads."""
    remedy: str = ""
    """Fix for an artifact in an older format."""


FOLDERS: Mapping[str, Format] = MappingProxyType(
    {
        "dataset": Format(),
        "inspection": Format(),
        "surrogate": Format(),
        "controller": Format(3, 3, "map or train again"),
        "evaluation": Format(2, 2, "evaluate again"),
        "calibration": Format(),
        "reproduction": Format(),
        "robot": Format(),
        "example": Format(),
    }
)
"""Formats of folders by kind; a ``KIND.json`` describes the folder."""

FILES: Mapping[str, Format] = MappingProxyType({"log": Format(), "recording": Format()})
"""Formats of single files. Logs (Parquet) store the number in the schema's metadata, recordings
(MCAP) in the channels' metadata."""

FORMATS: Mapping[str, Format] = MappingProxyType({**FOLDERS, **FILES})
"""Formats of all artifacts by kind."""

IN_FILE = "softfin_format"
"""Key of the format number in the metadata of single files; the value is a string."""


def check_format(
    kind: str, number: object, source: str, error: type[InputError] = ArtifactError
) -> None:
    """Raise an error of class `error` unless this version reads artifacts of this kind and format
    number."""
    newest, oldest, remedy = FORMATS[kind]
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise error(
            f"{source}: format is {str(number)[:80]!r}; it must be a whole number of at least 1; "
            "copy the file again"
        )
    span = newest if oldest == newest else f"{oldest} to {newest}"
    reads = f"this softfin reads {span}"
    if number > newest:
        raise error(
            f"{source}: format is {number}, written by a newer softfin; {reads}; update softfin"
        )
    if number < oldest:
        raise error(f"{source}: format is {number}, written by an older softfin; {reads}; {remedy}")


def check_file_format(
    kind: str, metadata: Mapping[Any, Any] | None, source: str, error: type[InputError] = LogError
) -> None:
    """Check the format number in the metadata of a single file; keys and values are strings or
    bytes."""
    entries = metadata or {}
    found = entries.get(IN_FILE, entries.get(IN_FILE.encode(), "1"))
    text = found.decode(errors="replace") if isinstance(found, bytes) else str(found)
    check_format(kind, int(text) if text.isdecimal() else text, source, error)
