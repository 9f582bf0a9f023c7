"""Gaits as a controller: no network, but a table of six actions for each node of a lattice of
references, interpolated in between.

It is the benchmark for the policies, their starting point, and a good choice if the controller must
be small.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, GaitTable, NamedArrays
from softfin.gaits.reachable import Cell, Cells


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
        description: JsonObject,
        arrays: NamedArrays,
        limits: Limits,
        cells: Cells,
    ) -> tuple["GaitStep", Cells]:
        """Build it from a controller's description and arrays; returns it with its lattice's
        box."""
        table = ForceMap.from_dict(description, arrays).gaits.table
        box = Cell(low=tuple(table.low.tolist()), high=tuple(table.high.tolist()))
        return cls(table), (box,)

    def init(self) -> GaitState:
        """Return the state before the first of the six actions."""
        return GaitState(0)

    def act(self, ops: Operations, state: GaitState, now: Array) -> tuple[GaitState, Array]:
        """Take the next action of the gait for the reference."""
        return GaitState(state.age + 1), ops.row(
            self.table.gait(now[1:], ops), state.age % CYCLE_ACTIONS
        )
