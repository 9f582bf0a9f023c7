"""Gaits on a lattice of reference forces, with interpolation between the nodes, and the force map
with their forces. This module does not import JAX.

A gait is a sequence of actions that fills one window of the action clock and is repeated, so that
in steady state it causes no ripple in the window's mean; on the paper's clock these are six.
Actions ``(actions, 2)`` are (angle, velocity), scaled so that the limits of the plant are -1 and 1.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.json_object import JsonObject
from softfin.core.operations import Number, Operations, select_operations
from softfin.core.quantities import AnyArray
from softfin.gaits.reachable import Cell, ForceVector, Reachable

Gait: TypeAlias = Float[AnyArray, "actions 2"]
NamedArrays: TypeAlias = Mapping[str, np.ndarray]


class GaitTable(NamedTuple):
    """A gait for each node of a lattice of references."""

    low: Float[AnyArray, "2"]
    """Lower corner (x, y) of the lattice [N]."""
    high: Float[AnyArray, "2"]
    """Upper corner (x, y) of the lattice [N]."""
    actions: Float[AnyArray, "x y actions 2"]
    """Actions of the gait at each node [-]; a gait lasts one window of the clock."""

    @classmethod
    def empty(
        cls,
        low: ForceVector,
        high: ForceVector,
        nodes: tuple[int, int],
        gait_actions: int = PAPER_CLOCK.window_actions,
    ) -> "GaitTable":
        """Return a table with all actions set to 0; `nodes` in x and y are at least 2."""
        actions = np.zeros((*nodes, gait_actions, 2), np.float32)
        return cls(np.asarray(low, np.float32), np.asarray(high, np.float32), actions)

    @classmethod
    def over(
        cls, cell: Cell, spacing_n: float, gait_actions: int = PAPER_CLOCK.window_actions
    ) -> "GaitTable":
        """Return an empty table over a cell, including its corners, with nodes at most `spacing_n`
        apart."""
        size = np.subtract(cell.high, cell.low)
        # 1e-6 prevents rounding errors from adding a node.
        x, y = np.maximum(2, np.ceil(size / spacing_n - 1e-6).astype(int) + 1).tolist()
        return cls.empty(cell.low, cell.high, (x, y), gait_actions)

    def halved(self, times: int = 1) -> "GaitTable":
        """Return an empty table over the same box, with the spacing halved `times` times."""
        x, y = self.nodes
        x = (x - 1) * 2**times + 1
        y = (y - 1) * 2**times + 1
        return self._replace(actions=np.zeros((x, y, *self.actions.shape[2:]), np.float32))

    @property
    def nodes(self) -> tuple[int, int]:
        """Number of nodes in x and y."""
        return self.actions.shape[0], self.actions.shape[1]

    @property
    def gait_actions(self) -> int:
        """Number of actions of a gait."""
        return int(self.actions.shape[2])

    def gait(self, reference: Any, operations: Operations | None = None) -> Any:
        """Interpolate the gaits of the four nodes around a reference; outside the lattice, use the
        nearest point of its edge."""
        ops = operations or select_operations(reference, self.actions)
        rows = self.actions.shape[1]
        table = ops.constant(self.actions.reshape(-1, self.gait_actions, 2))
        x, i = self._place(ops, reference[0], 0)
        y, j = self._place(ops, reference[1], 1)
        node = i * rows + j
        # Bilinear interpolation, where x and y are the distances from the lower node in units of
        # the spacing.
        blend = (1 - x) * (1 - y) * ops.row(table, node) + (1 - x) * y * ops.row(table, node + 1)
        return (
            blend
            + x * (1 - y) * ops.row(table, node + rows)
            + x * y * ops.row(table, node + rows + 1)
        )

    def references(self) -> Float[np.ndarray, "x y 2"]:
        """Return the references of the nodes [N]."""
        low = np.asarray(self.low, float)
        high = np.asarray(self.high, float)
        axes = map(np.linspace, low, high, self.nodes)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)

    def _place(self, ops: Operations, force: Number, axis: int) -> tuple[Number, Number]:
        """Return the distance of a force from the node below it along one axis, in units of the
        spacing, and the index of that node."""
        last = self.actions.shape[axis] - 1
        # The box of a single reference has no width, and all its nodes are equal; 1e-9 avoids a
        # division by 0.
        width = self.high[axis] - self.low[axis] + 1e-9
        place = last * ops.clip(ops.real((force - self.low[axis]) / width), 0.0, 1.0)
        node = ops.clip(ops.whole(place), 0, last - 1)
        return place - ops.real(node), node


class GaitSearchResult(NamedTuple):
    """A table of gaits, and their steady-state forces in the plant."""

    table: GaitTable
    force: Float[np.ndarray, "x y 2"]
    """Mean force over a window [N]."""
    smoothness: Float[np.ndarray, "x y 2"]
    """Sobolev term in the form `mean` [N]."""

    def force_error(self) -> Float[np.ndarray, "x y"]:
        """Return the distance of each node's force from its reference [N]."""
        return np.asarray(np.linalg.norm(self.force - self.table.references(), axis=-1))


def _is_box(low: np.ndarray, high: np.ndarray) -> bool:
    # Also false for NaN, because all comparisons with NaN are false.
    return bool(((-np.inf < low) & (low <= high) & (high < np.inf)).all())


class ForceMap(NamedTuple):
    """Mean forces that a fin can produce, and their gaits."""

    gaits: GaitSearchResult
    reachable: Reachable
    clock: ActionClock = PAPER_CLOCK
    """Clock of the gaits."""

    def to_dict(self) -> JsonObject:
        """Return the lattice and the region for JSON."""
        table = self.gaits.table
        return {
            "lattice": {
                "low_n": np.asarray(table.low, float).tolist(),
                "high_n": np.asarray(table.high, float).tolist(),
                "nodes": list(table.nodes),
            },
            "reachable": self.reachable.to_dict(),
            "clock": self.clock.model_dump(mode="json"),
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
        """Build a map from the results of `to_dict` and `arrays`.

        Raises:
            KeyError, TypeError, ValueError: the data do not describe a map.
        """
        lattice = description["lattice"]
        nodes = tuple(map(int, lattice["nodes"]))
        actions = np.asarray(arrays["actions"], np.float32)
        force = np.asarray(arrays["force_n"], np.float32)
        smoothness = np.asarray(arrays["smoothness_n"], np.float32)
        low = np.asarray(lattice["low_n"], np.float32)
        high = np.asarray(lattice["high_n"], np.float32)
        if low.shape != (2,) or high.shape != (2,) or not _is_box(low, high):
            raise ValueError(
                f"lattice from {low.tolist()} to {high.tolist()} N: must have two corners with low "
                "<= high"
            )
        gait_actions = actions.shape[2] if actions.ndim == 4 else 0
        shapes = (*nodes, gait_actions, 2), (*nodes, 2), (*nodes, 2)
        if (
            len(nodes) != 2
            or min(nodes) < 2
            or gait_actions == 0
            or (actions.shape, force.shape, smoothness.shape) != shapes
        ):
            raise ValueError(
                f"gaits with the shape {actions.shape} do not fit a lattice of {nodes} nodes; a "
                "lattice must have at least two nodes per side"
            )
        # 1e-5, because actions are rounded to float32.
        if not (
            np.isfinite(force).all()
            and np.isfinite(smoothness).all()
            and (abs(actions) <= 1 + 1e-5).all()
        ):
            raise ValueError(
                "gaits or forces are not finite, or actions are outside [-1, 1], the limits of the "
                "plant"
            )
        found = GaitSearchResult(GaitTable(low, high, actions), force, smoothness)
        clock = ActionClock.model_validate(description["clock"])
        if clock.window_actions != gait_actions:
            raise ValueError(
                f"gaits of {gait_actions} actions do not fit the window of the clock, "
                f"{clock.window_actions}"
            )
        return cls(found, Reachable.from_dict(description["reachable"]), clock)
