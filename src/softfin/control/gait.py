"""A controller without a network: a table with the actions of one window for each node of a lattice
of references. Between the nodes, it interpolates.

``softfin map`` finds the gaits.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import GaitTable, NamedArrays, parse_gaits
from softfin.gaits.reachable import Cells


class GaitState(NamedTuple):
    """State of a gait controller."""

    age: Number
    """Number of actions since the start; not reset when the reference moves, so that the gait keeps
    its phase."""


@dataclass(frozen=True)
class GaitStep:
    """Step of a gait controller, which is open loop and ignores the angle."""

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
        """Build the step from a controller's description and arrays; return it with the bounding
        box of its lattice."""
        table, box = parse_gaits(description, arrays)
        return cls(table), (box,)

    def init(self) -> GaitState:
        """Return the state before the first action of the gait."""
        return GaitState(0)

    def act(self, ops: Operations, state: GaitState, now: Array) -> tuple[GaitState, Array]:
        """Return the next action of the gait for the reference."""
        return GaitState(state.age + 1), ops.row(
            self.table.gait(now[1:], ops), state.age % self.table.gait_actions
        )
