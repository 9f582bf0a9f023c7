"""The operations that controllers' formulas are written in: the array API, and what differs between its libraries.

So each formula stands once. NumPy runs it on the robot, JAX compiles it, and the ONNX exporter traces it.
"""

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

Array: TypeAlias = Any
"""An array of whichever library runs the formula; float32 but for counts."""

Number: TypeAlias = Any
"""A Python number, a NumPy scalar or an array without axes."""


@runtime_checkable
class Operations(Protocol):
    """The operations of one library."""

    @property
    def xp(self) -> Any:
        """The library's namespace of the array API (2023.12)."""
        ...

    def row(self, table: Array, index: Number) -> Array:
        """Return ``table[index]`` along the first axis, for an index that is known only when the formula runs."""
        ...

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """Return one of two values, or tuples of values; the other one may be computed or not."""
        ...

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Return the product of a vector and a matrix."""
        ...

    def whole(self, number: Number) -> Number:
        """Round towards 0, to an integer."""
        ...

    def real(self, number: Number) -> Number:
        """Convert to a float32, or to a Python number, which does not widen one."""
        ...

    def constant(self, values: Array) -> Array:
        """Convert to an array of the library."""
        ...


class NumPyOperations:
    """NumPy; of two choices one is computed."""

    xp: Any = np

    def row(self, table: Array, index: Number) -> Array:
        """Index the table."""
        return table[index]

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """Branch."""
        return then() if condition else otherwise()

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Multiply, with less overhead than ``@``."""
        return vector.dot(matrix)

    def whole(self, number: Number) -> Number:
        """Convert to a Python integer."""
        return int(number)

    def real(self, number: Number) -> Number:
        """Convert to a Python number."""
        return float(number)

    def constant(self, values: Array) -> Array:
        """Return the array as it is."""
        return values


class JaxOperations:
    """JAX, imported when first used; both choices are computed, as under `jax.vmap` they always are."""

    @property
    def xp(self) -> Any:
        """The namespace ``jax.numpy``."""
        import jax.numpy

        return jax.numpy

    def row(self, table: Array, index: Number) -> Array:
        """Index the table dynamically."""
        return self.xp.asarray(table)[index]

    def choose(self, condition: Number, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """Select with ``where``, part by part."""
        import jax

        return jax.tree.map(lambda one, other: self.xp.where(condition, one, other), then(), otherwise())

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Multiply."""
        return vector @ matrix

    def whole(self, number: Number) -> Number:
        """Convert to int32."""
        return self.xp.asarray(number).astype(np.int32)

    def real(self, number: Number) -> Number:
        """Convert to float32."""
        return self.xp.asarray(number).astype(np.float32)

    def constant(self, values: Array) -> Array:
        """Convert to a JAX array."""
        return self.xp.asarray(values)


NUMPY, JAX = NumPyOperations(), JaxOperations()


def operations_of(*values: Any) -> Operations:
    """Return NumPy's operations where all values are Python's or NumPy's, else JAX's."""
    for value in values:
        if not isinstance(value, (float, int, np.ndarray, np.generic, tuple)):
            return JAX
    return NUMPY
