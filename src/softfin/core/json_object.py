"""Type of the contents of JSON and YAML files."""

from typing import Any, TypeAlias

JsonObject: TypeAlias = dict[str, Any]
"""A JSON or YAML object: maps names to numbers, strings, lists or objects."""
