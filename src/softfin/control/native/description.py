"""What a ``controller.json`` says, checked value by value: hostile or damaged, it ends in one line."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from softfin.core.errors import ArtifactError

AGAIN = "copy the folder again, or train it again"
"""What helps where a folder is no longer what was written."""

LARGEST = 1e4
"""No limit, force or weight of a fin's controller comes near it; beyond, float32 sums would no longer be finite."""

MEMORY = 10_000
"""Most past actions that a description may claim."""


class Described(NamedTuple):
    """One object of the JSON, and where it stands."""

    values: Mapping[str, Any]
    source: str

    def part(self, name: str) -> "Described":
        """An object within."""
        value = self.values.get(name)
        if not isinstance(value, dict):
            raise self.wrong(name, "an object")
        return Described(value, f"{self.source}: {name}")

    def number(self, name: str, least: float | int = -LARGEST, default: float | int | None = None) -> float:
        """A finite number, not under `least`."""
        return self._number(name, self.values.get(name, default), least)

    def whole(self, name: str, most: int, default: int | None = None, least: int = 0) -> int:
        """An integer."""
        value = self.values.get(name, default)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise self.wrong(name, f"a whole number from {least} to {most}")
        return value

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self.values.get(name, default)
        if not isinstance(value, bool):
            raise self.wrong(name, "true or false")
        return value

    def text(self, name: str) -> str | None:
        """A string, or none."""
        value = self.values.get(name)
        if value is not None and not isinstance(value, str):
            raise self.wrong(name, "a string or null")
        return value

    def numbers(self, name: str, least: float | int = -LARGEST) -> tuple[float, ...]:
        """A list of finite numbers."""
        values = self.values.get(name)
        if not isinstance(values, list):
            raise self.wrong(name, "a list of numbers")
        return tuple(self._number(name, value, least) for value in values)

    def pair(self, name: str) -> tuple[float, float]:
        """Two finite numbers."""
        values = self.numbers(name)
        if len(values) != 2:
            raise self.wrong(name, "two numbers")
        return values[0], values[1]

    def wrong(self, name: str, wanted: str) -> ArtifactError:
        """Not what it should be."""
        met = repr(self.values[name]) if name in self.values else "missing"
        return ArtifactError(f"{self.source}: {name} is {' '.join(met[:80].split())}; it must be {wanted}; {AGAIN}")

    def _number(self, name: str, value: Any, least: float | int) -> float:
        known = isinstance(value, int | float) and not isinstance(value, bool)
        if not known or not (least <= value <= LARGEST) or not math.isfinite(value):
            raise self.wrong(name, f"{'numbers' if name not in self.values else 'finite'}, {least:g} .. {LARGEST:g}")
        return float(value)
