"""The type of what JSON and YAML files contain."""

from typing import Any, TypeAlias

JsonObject: TypeAlias = dict[str, Any]
"""A JSON or YAML object: maps names to numbers, strings, lists or objects."""
