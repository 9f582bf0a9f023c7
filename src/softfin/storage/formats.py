"""Every kind of artifact that softfin writes, with its format number: the only list of both.

The number of a kind is raised when older versions of softfin cannot read what is written now;
`oldest` then stays, the reader of the older format is kept, and ``tests/golden`` gets a file in the
new one. Added keys do not change the number. A file without a number is of format 1. Configurations
(YAML) have none: their keys are checked by name.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from softfin.core.errors import ArtifactError, InputError, LogError


class Format(NamedTuple):
    """Format number of one kind of artifact, and the formats that this softfin reads."""

    number: int = 1
    """Format that this softfin writes, and the newest that it reads."""
    oldest: int = 1
    """Oldest format that it reads."""
    remedy: str = ""
    """How to get a new artifact if this one is older."""


FOLDERS: Mapping[str, Format] = MappingProxyType(
    {
        "dataset": Format(),
        "inspection": Format(),
        "surrogate": Format(),
        "comparison": Format(),
        "map": Format(),
        "controller": Format(2, 2, "train it again"),
        "controllers": Format(),
        "evaluation": Format(2, 2, "evaluate again"),
        "baselines": Format(),
        "calibration": Format(),
        "reproduction": Format(),
        "robot": Format(),
        "example": Format(),
    }
)
"""Folders by their kind, which is described by its ``KIND.json``."""

FILES: Mapping[str, Format] = MappingProxyType({"log": Format(), "recording": Format()})
"""Single files: logs (Parquet) have the number in the metadata of their schema, recordings (MCAP)
in that of their channels."""

FORMATS: Mapping[str, Format] = MappingProxyType({**FOLDERS, **FILES})
"""All of them."""

IN_FILE = "softfin_format"
"""Key of the number in the metadata of single files, where it is a string."""


def check_format(
    kind: str, number: object, source: str, error: type[InputError] = ArtifactError
) -> None:
    """Raise the error unless this softfin reads artifacts of this kind and format number."""
    newest, oldest, remedy = FORMATS[kind]
    if isinstance(number, bool) or not isinstance(number, int) or number < 1:
        raise error(
            f"{source}: format is {str(number)[:80]!r}; it must be a whole number from 1 on; copy "
            "it again"
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
    """Check the number in the metadata of a single file; keys and values are strings or bytes."""
    entries = metadata or {}
    found = entries.get(IN_FILE, entries.get(IN_FILE.encode(), "1"))
    text = found.decode(errors="replace") if isinstance(found, bytes) else str(found)
    check_format(kind, int(text) if text.isdecimal() else text, source, error)
