"""Gaits on a lattice of reference forces with interpolation between the nodes, and the force map.
This module does not import JAX.

A gait is a repeated sequence of actions that fills one window of the action clock (six actions on
the paper's clock). In steady state, it therefore causes no ripple in the mean over the window.
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
        """Return a table with all actions set to 0; there must be at least 2 nodes in x and in
        y."""
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

    def halved(self) -> "GaitTable":
        """Return an empty table over the same box, with half the spacing."""
        x, y = self.nodes
        shape = (2 * x - 1, 2 * y - 1, *self.actions.shape[2:])
        return self._replace(actions=np.zeros(shape, np.float32))

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
        """Return the references at the nodes [N]."""
        low = np.asarray(self.low, float)
        high = np.asarray(self.high, float)
        axes = map(np.linspace, low, high, self.nodes)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)

    def _place(self, ops: Operations, force: Number, axis: int) -> tuple[Number, Number]:
        """Return the distance of a force from the node below it along one axis (in units of the
        spacing) and the index of this node."""
        last = self.actions.shape[axis] - 1
        # The box of a single reference has no width, and all its nodes are equal; 1e-9 avoids a
        # division by 0.
        width = self.high[axis] - self.low[axis] + 1e-9
        place = last * ops.clip(ops.real((force - self.low[axis]) / width), 0.0, 1.0)
        node = ops.clip(ops.whole(place), 0, last - 1)
        return place - ops.real(node), node


class GaitSearchResult(NamedTuple):
    """A table of gaits and their steady-state forces in the plant."""

    table: GaitTable
    force: Float[np.ndarray, "x y 2"]
    """Mean force over a window [N]."""
    smoothness: Float[np.ndarray, "x y 2"]
    """Sobolev term in the form `mean` [N]."""
    power: Float[np.ndarray, "x y"] | None = None
    """Mean power delivered to the fin [W]; None if the plant does not provide the torque."""

    def force_error(self) -> Float[np.ndarray, "x y"]:
        """Return the distance of each node's force from its reference [N]."""
        return np.asarray(np.linalg.norm(self.force - self.table.references(), axis=-1))


class ForceMap(NamedTuple):
    """Reachable mean forces and their gaits."""

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
        arrays = {
            "actions": np.asarray(gaits.table.actions),
            "force_n": gaits.force,
            "smoothness_n": gaits.smoothness,
        }
        return arrays if gaits.power is None else arrays | {"power_w": gaits.power}


def parse_gaits(description: Mapping[str, Any], arrays: NamedArrays) -> tuple[GaitTable, Cell]:
    """Return the gaits of a map and the box of their lattice, from the results of
    `ForceMap.to_dict` and `ForceMap.arrays`.

    Raises:
        KeyError, TypeError, ValueError: the data do not describe a map.
    """
    lattice = description["lattice"]
    box = Cell.model_validate({"low": lattice["low_n"], "high": lattice["high_n"]})
    nodes = tuple(map(int, lattice["nodes"]))
    gait_actions = ActionClock.model_validate(description["clock"]).window_actions
    actions = arrays["actions"]
    force = arrays["force_n"]
    smoothness = arrays["smoothness_n"]
    shapes = (*nodes, gait_actions, 2), (*nodes, 2), (*nodes, 2)
    if (
        len(nodes) != 2
        or min(nodes) < 2
        or (actions.shape, force.shape, smoothness.shape) != shapes
    ):
        raise ValueError(
            f"gaits with the shape {actions.shape} do not fit a lattice of {nodes} nodes and a "
            f"clock with {gait_actions} actions per window; a lattice must have at least two nodes "
            "per side"
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
    low = np.asarray(box.low, np.float32)
    return GaitTable(low, np.asarray(box.high, np.float32), actions), box
