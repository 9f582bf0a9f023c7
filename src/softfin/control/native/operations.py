"""What the steps of the controllers are written in: the array API, and what differs between its libraries.

So each formula stands once. NumPy runs it on the robot; an exporter traces it with another library of the array API.
"""

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

Array: TypeAlias = Any
"""Of whichever library runs the step; float32 but for counts."""

Number: TypeAlias = Any
"""A Python number, a NumPy scalar or an array without axes."""


@runtime_checkable
class Operations(Protocol):
    """One library."""

    @property
    def xp(self) -> Any:
        """Its namespace of the array API (2023.12)."""
        ...

    def row(self, table: Array, index: Number) -> Array:
        """``table[index]`` along the first axis, for an index that is known only when the step runs."""
        ...

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """One of two values, or tuples of values; the other one may be worked out or not."""
        ...

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Their product."""
        ...

    def whole(self, number: Number) -> Number:
        """Towards 0, as an integer."""
        ...

    def real(self, number: Number) -> Number:
        """As a float32, or as a Python number, which does not widen one."""
        ...

    def constant(self, values: np.ndarray) -> Array:
        """An array of the library."""
        ...


class NumPy:
    """NumPy itself: of two choices one is worked out."""

    xp: Any = np

    def row(self, table: Array, index: Number) -> Array:
        """By indexing."""
        return table[index]

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """As an ``if``."""
        return then() if condition else otherwise()

    def dot(self, vector: Array, matrix: Array) -> Array:
        """As ``@``, with less overhead."""
        return vector.dot(matrix)

    def whole(self, number: Number) -> Number:
        """As a Python integer."""
        return int(number)

    def real(self, number: Number) -> Number:
        """As a Python number."""
        return float(number)

    def constant(self, values: np.ndarray) -> Array:
        """As it is."""
        return values


NUMPY = NumPy()
