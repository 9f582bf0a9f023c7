"""Grid-switching (paper Sec. III-C3, second design): one policy per cell of reference forces.

The policy is switched when the reference enters a different cell. The new policy first replays the
observations of the last window, so its memory is the same as if it had been active throughout.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from softfin.control.controller import STATIC
from softfin.control.policy import PolicyMemory, PolicyNetwork, PolicyObservation, fold, rest_action
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import NamedArrays
from softfin.gaits.reachable import Cells, cell_corners


class GridState(NamedTuple):
    """Memory of the active policy, and the data that a different policy needs to take over."""

    hidden: Array
    cell: Array
    actions: Array
    """Past actions in [-1, 1], newest first: one window, and the earlier actions that its first
    observation contains."""
    angles: Array
    """Shaft angle at each action of the last window, newest first [rad]."""
    age: Number
    """Number of actions since the start."""
    active_cell: Number
    """Index of the cell whose policy is active."""


@dataclass(frozen=True)
class GridStep:
    """Step of a controller with a grid of policies."""

    kind: ClassVar[str] = "grid"
    networks: PolicyNetwork
    """Networks with a leading axis of cells."""
    low: Array
    """Lower corners of the cells ``(cells, 2)`` [N]."""
    high: Array
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
    ) -> tuple["GridStep", Cells]:
        """Build the step from a controller's description and arrays; return the step and its
        cells."""
        if not cells:
            raise ValueError("cells: empty; a grid needs at least one cell")
        observation = PolicyObservation.from_description(description)
        networks = fold(arrays, observation, (len(cells),))
        return cls(networks, *cell_corners(cells), rest_action(limits), observation), cells

    @property
    def window_actions(self) -> int:
        """Number of actions in the window of the clock."""
        return self.observation.clock.window_actions

    def init(self) -> GridState:
        """Return the state for a fin at rest."""
        return GridState(
            *self.networks.empty(),
            actions=np.tile(
                np.asarray(self.rest, np.float32),
                self.window_actions + self.observation.past_actions + 1,
            ),
            angles=np.zeros(self.window_actions, np.float32),
            age=0,
            active_cell=0,
        )

    def act(self, ops: Operations, state: GridState, now: Array) -> tuple[GridState, Array]:
        """Compute the deterministic action of the policy for the reference's cell."""
        xp = ops.xp
        reference = now[1:]
        active_cell = self.nearest_cell(ops, reference)
        switched = (active_cell != state.active_cell) & (state.age > 0)
        network = PolicyNetwork(
            *[ops.row(part, active_cell) for part in ops.constant(self.networks)]
        )
        memory = PolicyMemory(
            *ops.choose(
                switched,
                lambda: self._warm_up_memory(ops, network, state, reference),
                lambda: PolicyMemory(state.hidden, state.cell),
            )
        )
        memory = network.remember(ops, memory, self.observation.observe(ops, now, state.actions))
        action = network.action(ops, memory)
        after = GridState(
            *memory,
            actions=xp.concat([action, state.actions[:-2]]),
            angles=xp.concat([now[:1], state.angles[:-1]]),
            age=state.age + 1,
            active_cell=active_cell,
        )
        return after, action

    def nearest_cell(self, ops: Operations, reference: Array) -> Number:
        """Return the index of the cell that contains the reference, or of the nearest one."""
        xp = ops.xp
        low = ops.constant(self.low)
        high = ops.constant(self.high)
        beyond = xp.maximum(xp.maximum(low - reference, reference - high), 0 * low)
        # Squared distance of the reference from each cell; 0 inside a cell.
        distance = beyond[:, 0] * beyond[:, 0] + beyond[:, 1] * beyond[:, 1]
        return ops.whole(xp.argmin(distance))

    def _warm_up_memory(
        self, ops: Operations, network: PolicyNetwork, state: GridState, reference: Array
    ) -> PolicyMemory:
        """Replay up to one window of past actions as if the present reference had been constant."""

        def replayed(memory: PolicyMemory, ago: int) -> PolicyMemory:
            now = ops.xp.concat([state.angles[ago - 1 : ago], reference])
            observation = self.observation.observe(ops, now, state.actions[2 * ago :])
            return network.remember(ops, memory, observation)

        empty: PolicyMemory = ops.constant(network.empty())
        memory = empty
        # Start with the oldest action; before the start of the episode, the memory stays empty.
        for ago in range(self.window_actions, 0, -1):
            memory = PolicyMemory(
                *ops.choose(state.age >= ago, partial(replayed, memory, ago), lambda: empty)
            )
        return memory
