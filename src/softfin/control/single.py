"""A single policy for the entire range of references (paper Sec. III-C3, first design)."""

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from softfin.control.controller import STATIC
from softfin.control.policy import PolicyMemory, PolicyNetwork, PolicyObservation, fold, rest_action
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import NamedArrays
from softfin.gaits.reachable import Cells


class SingleState(NamedTuple):
    """State of a controller with a single policy."""

    hidden: Array
    cell: Array
    actions: Array
    """Past actions in [-1, 1], newest first, concatenated."""


@dataclass(frozen=True)
class SingleStep:
    """Step of a controller with a single policy."""

    kind: ClassVar[str] = "single"
    network: PolicyNetwork
    rest: tuple[float, float] = field(metadata=STATIC)
    """Action that keeps the fin at its rest angle."""
    observation: PolicyObservation = field(metadata=STATIC)

    @classmethod
    def load(
        cls,
        description: JsonObject,
        arrays: NamedArrays,
        limits: Limits,
        cells: Cells,
    ) -> tuple["SingleStep", Cells]:
        """Build the step from a controller's description and arrays; return the step and its
        cell."""
        if len(cells) != 1:
            raise ValueError(f"cells: got {len(cells)}; a single controller must have one")
        observation = PolicyObservation.from_description(description)
        return cls(fold(arrays, observation), rest_action(limits), observation), cells

    def init(self) -> SingleState:
        """Return the state for a fin at rest."""
        return SingleState(
            *self.network.empty(),
            np.tile(np.asarray(self.rest, np.float32), self.observation.past_actions + 1),
        )

    def act(self, ops: Operations, state: SingleState, now: Array) -> tuple[SingleState, Array]:
        """Compute the policy's deterministic action."""
        network: PolicyNetwork = ops.constant(self.network)
        observation = self.observation.observe(ops, now, state.actions)
        memory = network.remember(ops, PolicyMemory(state.hidden, state.cell), observation)
        action = network.action(ops, memory)
        return SingleState(*memory, ops.xp.concat([action, state.actions[:-2]])), action
