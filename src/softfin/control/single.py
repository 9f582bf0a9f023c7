"""A single policy for the entire range of references (paper Sec. III-C3, first design)."""

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from softfin.control.controller import STATIC
from softfin.control.policy import PolicyMemory, PolicyNetwork, PolicyObservation, fold, rest_action
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import GaitTable, NamedArrays
from softfin.gaits.reachable import Cells


class SingleState(NamedTuple):
    """State of a controller with a single policy."""

    hidden: Array
    cell: Array
    actions: Array
    """Past actions in [-1, 1], newest first, concatenated."""
    age: Number
    """Number of actions since the start."""


@dataclass(frozen=True)
class SingleStep:
    """Step of a controller with a single policy."""

    kind: ClassVar[str] = "single"
    network: PolicyNetwork
    rest: tuple[float, float] = field(metadata=STATIC)
    """Action that keeps the fin at its rest angle."""
    observation: PolicyObservation = field(metadata=STATIC)
    gaits: GaitTable | None = None
    """Gaits to which the policy adds its actions, if any."""

    @classmethod
    def load(
        cls,
        description: JsonObject,
        arrays: NamedArrays,
        limits: Limits,
        cells: Cells,
    ) -> tuple["SingleStep", Cells]:
        """Build the step from a controller's description and arrays; return it with its cell."""
        if len(cells) != 1:
            raise ValueError(f"cells: got {len(cells)}; a single controller must have one")
        observation = PolicyObservation.from_description(description)
        network, gaits = fold(arrays, observation)
        return cls(network, rest_action(limits), observation, gaits), cells

    def init(self) -> SingleState:
        """Return the state for a fin at rest."""
        return SingleState(
            *self.network.empty(),
            np.tile(np.asarray(self.rest, np.float32), self.observation.past_actions + 1),
            0,
        )

    def act(self, ops: Operations, state: SingleState, now: Array) -> tuple[SingleState, Array]:
        """Compute the policy's deterministic action."""
        network: PolicyNetwork = ops.constant(self.network)
        observation = self.observation.observe(ops, now, state.actions, state.age)
        memory = network.remember(ops, PolicyMemory(state.hidden, state.cell), observation)
        action = network.action(ops, memory, self.gaits, now[1:], state.age)
        return SingleState(
            *memory, ops.xp.concat([action, state.actions[:-2]]), state.age + 1
        ), action
