"""Contents of JSON and YAML files."""

from collections.abc import Mapping
from typing import Any, TypeAlias

JsonObject: TypeAlias = dict[str, Any]
"""A JSON or YAML object, which maps names to numbers, strings, lists or objects."""


def describe_changes(before: Mapping[str, object], now: Mapping[str, object]) -> str:
    """Return the first three names whose values differ, with both values; empty if no values
    differ."""
    changes = [
        f"{name} was {before.get(name)!r} and is {now.get(name)!r}"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    ]
    return ", ".join(changes[:3])
