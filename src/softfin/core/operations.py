"""Operations used in the controllers' formulas: the array API, and operations that differ between
array libraries.

Each formula exists only once: NumPy runs it on the robot, JAX compiles it, and ndonnx traces it for
ONNX.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias

import numpy as np

Array: TypeAlias = Any
"""Array of the library that runs the formula; float32 except for counts."""

Number: TypeAlias = Any
"""Python number, NumPy scalar or array without axes."""


class Operations:
    """Operations with NumPy; subclasses override them for other libraries."""

    xp: Any = np
    """The library's array API namespace (2023.12)."""

    def row(self, table: Array, index: Number) -> Array:
        """Return ``table[index]`` along the first axis, for an index known only at run time."""
        return table[index]

    def choose(
        self, condition: Number, then: Callable[[], object], otherwise: Callable[[], object]
    ) -> Any:
        """Return one of two values or tuples of values; the other may also be computed."""
        return then() if condition else otherwise()

    def branch(
        self, condition: Number, then: Callable[[], object], otherwise: Callable[[], object]
    ) -> Any:
        """Return one of two values, like `choose`, for values that are expensive: if the condition
        is the same for the whole batch, the other value is not computed."""
        return self.choose(condition, then, otherwise)

    def dot(self, vector: Array, matrix: Array) -> Array:
        """Return the product of a vector and a matrix."""
        return vector.dot(matrix)

    def solve(self, system: Array, right: Array) -> tuple[Array, Number]:
        """Return the solution of a system of equations, and the logarithm of the determinant of its
        square matrix."""
        return np.linalg.solve(system, right), np.linalg.slogdet(system)[1]

    def whole(self, number: Number) -> Number:
        """Round towards 0, to an integer."""
        return int(number)

    def real(self, number: Number) -> Number:
        """Convert to float32, or to a Python number, which does not promote a float32 array."""
        return float(number)

    def clip(self, number: Number, low: Number, high: Number) -> Number:
        """Limit a number."""
        return min(max(number, low), high)

    def constant(self, values: object) -> Any:
        """Convert an array, or a named tuple of arrays, to this library."""
        return values


class JaxOperations(Operations):
    """Operations with JAX; `choose` computes both values, as always under `jax.vmap`."""

    def __init__(self) -> None:
        import jax

        self.xp = jax.numpy
        self._map = jax.tree.map
        self._cond = jax.lax.cond
        self._loop = jax.lax.fori_loop

    def row(self, table: Array, index: Number) -> Array:
        """Index the table dynamically."""
        return self.xp.asarray(table)[index]

    def choose(
        self, condition: Number, then: Callable[[], object], otherwise: Callable[[], object]
    ) -> Any:
        """Select with ``where``, leaf by leaf."""
        return self._map(
            lambda one, other: self.xp.where(condition, one, other), then(), otherwise()
        )

    def branch(
        self, condition: Number, then: Callable[[], object], otherwise: Callable[[], object]
    ) -> Any:
        """Compute one of the two values with ``cond``."""
        return self._cond(condition, then, otherwise)

    def solve(self, system: Array, right: Array) -> tuple[Array, Number]:
        """Solve by Gauss-Jordan elimination with partial pivoting.

        Not with LAPACK: two of its calls for batches of systems, at the same time in one program,
        wait for each other's threads for ever (jaxlib 0.10.2, two cores).
        """
        xp = self.xp
        size = len(system)
        index = xp.arange(size)

        def eliminate(k: Number, state: tuple[Array, Number]) -> tuple[Array, Number]:
            rows, logarithm = state
            largest = xp.where(index < k, -1.0, xp.abs(rows[:, k])).argmax()
            row = rows[largest]
            rows = rows.at[largest].set(rows[k])
            pivot = row[k]
            row = row / pivot
            rows = (rows - rows[:, k, None] * row).at[k].set(row)
            return rows, logarithm + xp.log(xp.abs(pivot))

        both = xp.concatenate([system, right], axis=1)
        rows, logarithm = self._loop(0, size, eliminate, (both, xp.zeros((), both.dtype)))
        return rows[:, size:], logarithm

    def whole(self, number: Number) -> Number:
        """Convert to int32."""
        return self.xp.asarray(number).astype(np.int32)

    def real(self, number: Number) -> Number:
        """Convert to float32."""
        return self.xp.asarray(number).astype(np.float32)

    def clip(self, number: Number, low: Number, high: Number) -> Number:
        """Limit a number."""
        return self.xp.clip(number, low, high)

    def constant(self, values: object) -> Any:
        """Convert to JAX arrays."""
        return self._map(self.xp.asarray, values)


NUMPY = Operations()
jax_operations = cache(JaxOperations)
"""Return the operations with JAX, which is imported on first use."""


def select_operations(*values: object) -> Operations:
    """Return NumPy's operations if all values are Python or NumPy objects, otherwise JAX's."""
    for value in values:
        if not isinstance(value, (float, int, np.ndarray, np.generic, tuple)):
            return jax_operations()
    return NUMPY
