"""Gaits as a controller: no network, but a table of six actions for each node of a lattice of
references, interpolated in between.

It is the benchmark for the policies, their starting point, and a good choice if the controller must
be small.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, GaitTable
from softfin.gaits.reachable import Cell


class GaitState(NamedTuple):
    """State of a gait controller."""

    age: Number
    """Actions since the start. The count continues when the reference moves, so that the gait keeps
    its phase."""


@dataclass(frozen=True)
class GaitStep:
    """Step of a gait controller; open loop, so the angle is not used."""

    kind: ClassVar[str] = "gaits"
    table: GaitTable

    @classmethod
    def load(
        cls,
        description: Mapping[str, object],
        arrays: Mapping[str, np.ndarray],
        limits: Limits,
        cells: tuple[Cell, ...],
    ) -> tuple["GaitStep", tuple[Cell, ...]]:
        """Build it from a controller's description and arrays; returns it with its lattice's
        box."""
        table = ForceMap.from_dict(description, arrays).gaits.table
        (x0, y0) = table.low.tolist()
        (x1, y1) = table.high.tolist()
        return cls(table), (Cell(low=(x0, y0), high=(x1, y1)),)

    def init(self) -> GaitState:
        """Return the state before the first of the six actions."""
        return GaitState(0)

    def act(self, ops: Operations, state: GaitState, now: Array) -> tuple[GaitState, Array]:
        """Take the next action of the gait for the reference."""
        return GaitState(state.age + 1), ops.row(
            self.table.gait(now[1:], ops), state.age % CYCLE_ACTIONS
        )
