"""Gaits on a lattice of reference forces, interpolated in between; and the force map with the
forces that they make. No JAX.

A gait is six actions, repeated: on the 33/33/34 clock they fill the window of the moving average
exactly, so in the steady state a gait leaves no ripple in it. Its actions ``(6, 2)`` are in [-1,
1], (angle, velocity) over the limits.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.json_object import JsonObject
from softfin.core.operations import Number, Operations, select_operations
from softfin.core.quantities import AnyArray
from softfin.gaits.reachable import Cell, ForceVector, Reachable

Gait: TypeAlias = Float[AnyArray, "6 2"]
NamedArrays: TypeAlias = Mapping[str, np.ndarray]


class GaitTable(NamedTuple):
    """Gaits for the nodes of a lattice of references."""

    low: Float[AnyArray, "2"]
    """Lower corner (x, y) of the lattice [N]."""
    high: Float[AnyArray, "2"]
    actions: Float[AnyArray, "x y 6 2"]

    @classmethod
    def empty(cls, low: ForceVector, high: ForceVector, nodes: tuple[int, int]) -> "GaitTable":
        """A table of `nodes` in x and y, 2 or more, in which every action is 0."""
        actions = np.zeros((*nodes, CYCLE_ACTIONS, 2), np.float32)
        return cls(np.asarray(low, np.float32), np.asarray(high, np.float32), actions)

    @classmethod
    def over(cls, cell: Cell, spacing_n: float) -> "GaitTable":
        """Return an empty table with nodes at most `spacing_n` apart, including the corners of the
        cell."""
        size = np.subtract(cell.high, cell.low)
        x, y = np.maximum(2, np.ceil(size / spacing_n - 1e-6).astype(int) + 1).tolist()
        return cls.empty(cell.low, cell.high, (x, y))

    def halved(self, times: int = 1) -> "GaitTable":
        """Return an empty table over the same box, with its spacing halved `times` times."""
        x, y = ((count - 1) * 2**times + 1 for count in self.nodes)
        return self._replace(actions=np.zeros((x, y, CYCLE_ACTIONS, 2), np.float32))

    @property
    def nodes(self) -> tuple[int, int]:
        """Number of nodes in x and y."""
        return self.actions.shape[0], self.actions.shape[1]

    def gait(self, reference: Any, operations: Operations | None = None) -> Any:
        """Interpolate the gaits of the four nodes around the reference; outside the lattice, use
        its edge."""
        ops = operations or select_operations(reference, self.actions)
        rows = self.actions.shape[1]
        table = ops.constant(self.actions.reshape(-1, CYCLE_ACTIONS, 2))
        x, i = self._place(ops, reference[0], 0)
        y, j = self._place(ops, reference[1], 1)
        node = i * rows + j
        # Bilinear interpolation.
        blend = (1 - x) * (1 - y) * ops.row(table, node) + (1 - x) * y * ops.row(table, node + 1)
        return (
            blend
            + x * (1 - y) * ops.row(table, node + rows)
            + x * y * ops.row(table, node + rows + 1)
        )

    def references(self) -> Float[np.ndarray, "x y 2"]:
        """References of the nodes [N]."""
        low = np.asarray(self.low, float)
        high = np.asarray(self.high, float)
        axes = map(np.linspace, low, high, self.nodes)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)

    def _place(self, ops: Operations, force: Number, axis: int) -> tuple[Number, Number]:
        """Return, along one axis, the node before a force and the distance from it in units of the
        spacing."""
        last = self.actions.shape[axis] - 1
        # A box for a single reference has no width, so all its nodes are equal.
        width = self.high[axis] - self.low[axis] + 1e-9
        place = last * ops.clip(ops.real((force - self.low[axis]) / width), 0.0, 1.0)
        node = ops.clip(ops.whole(place), 0, last - 1)
        return place - ops.real(node), node


class GaitSearchResult(NamedTuple):
    """A table of gaits, and the forces that they make in the plant in the steady state."""

    table: GaitTable
    force: Float[np.ndarray, "x y 2"]
    """Mean force over a window [N]."""
    smoothness: Float[np.ndarray, "x y 2"]
    """Sobolev term in the form `mean` [N]."""

    def force_error(self) -> Float[np.ndarray, "x y"]:
        """Distance of each node's force from its reference [N]."""
        return np.asarray(np.linalg.norm(self.force - self.table.references(), axis=-1))


def _is_box(low: np.ndarray, high: np.ndarray) -> bool:
    # Comparisons with NaN are false.
    return bool(((-np.inf < low) & (low <= high) & (high < np.inf)).all())


class ForceMap(NamedTuple):
    """Mean forces that a fin can make, and gaits for them."""

    gaits: GaitSearchResult
    reachable: Reachable

    def to_dict(self) -> JsonObject:
        """Return lattice and region for JSON."""
        table = self.gaits.table
        return {
            "lattice": {
                "low_n": np.asarray(table.low, float).tolist(),
                "high_n": np.asarray(table.high, float).tolist(),
                "nodes": list(table.nodes),
            },
            "reachable": self.reachable.to_dict(),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the gaits and their forces as named arrays."""
        gaits = self.gaits
        return {
            "actions": np.asarray(gaits.table.actions),
            "force_n": gaits.force,
            "smoothness_n": gaits.smoothness,
        }

    @classmethod
    def from_dict(cls, description: Mapping[str, Any], arrays: NamedArrays) -> "ForceMap":
        """Build a map from the results of `to_dict` and `arrays`; raises KeyError, TypeError or
        ValueError otherwise."""
        lattice = description["lattice"]
        nodes = tuple(map(int, lattice["nodes"]))
        actions, force, smoothness = (
            np.asarray(arrays[n], np.float32) for n in ("actions", "force_n", "smoothness_n")
        )
        low = np.asarray(lattice["low_n"], np.float32)
        high = np.asarray(lattice["high_n"], np.float32)
        if low.shape != (2,) or high.shape != (2,) or not _is_box(low, high):
            raise ValueError(
                f"lattice from {low.tolist()} to {high.tolist()} N; it must be two corners, low <= "
                "high"
            )
        shapes = (*nodes, CYCLE_ACTIONS, 2), (*nodes, 2), (*nodes, 2)
        if (
            len(nodes) != 2
            or min(nodes) < 2
            or (actions.shape, force.shape, smoothness.shape) != shapes
        ):
            raise ValueError(
                f"gaits {actions.shape} do not fit a lattice of {nodes} nodes, two or more per side"
            )
        # Actions were rounded to float32.
        if not (
            np.isfinite(force).all()
            and np.isfinite(smoothness).all()
            and (abs(actions) <= 1 + 1e-5).all()
        ):
            raise ValueError(
                "gaits or forces are not finite, or gaits are not within [-1, 1], the limits of "
                "the plant"
            )
        found = GaitSearchResult(GaitTable(low, high, actions), force, smoothness)
        return cls(found, Reachable.from_dict(description["reachable"]))
