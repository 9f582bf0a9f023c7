"""Grid-switching (paper Sec. III-C3, second design): one policy per cell of reference forces.

The policy is switched when the reference enters another cell. The switch should not disturb the
force. Therefore, the active policy stays active slightly beyond the border of its cell
(hysteresis). The next policy first replays the observations of the last window of the
clock, and its actions are blended with those of the previous window (bumpless transfer).
"""

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from softfin.control.controller import STATIC
from softfin.control.policy import PolicyMemory, PolicyNetwork, PolicyObservation, fold, rest_action
from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.operations import Array, Number, Operations
from softfin.core.quantities import Limits
from softfin.gaits.gait import GaitTable, NamedArrays
from softfin.gaits.reachable import Cells, cell_corners


class SwitchingConfig(Configuration):
    """Configuration of the switch between policies."""

    margin_n: NonNegativeFloat = 0.1
    """Hysteresis [N]: the active policy stays active until another cell is nearer to the reference
    by more than this, so that a reference on the border does not cause constant switching. Policies
    can still hold a reference this far outside their cell."""
    fade_actions: NonNegativeInt = 6
    """Number of actions over which the new policy is blended in; 0 switches immediately."""
    step_n: PositiveFloat = 0.5
    """Movement of the reference between two actions above which it counts as a step [N]. After a
    step nothing is blended; after smaller movements, blending is partial."""
    replay: bool = True
    """Whether the new policy replays the last window's actions to fill its memory; otherwise, it
    starts with an empty memory."""


class GridState(NamedTuple):
    """Memory of the active policy, and the data that another policy needs to take over."""

    hidden: Array
    cell: Array
    actions: Array
    """Past actions in [-1, 1], newest first: one window, and the earlier actions observed at its
    start."""
    angles: Array
    """Angle of the shaft at each action of the last window, newest first [rad]."""
    last_reference: Array
    """Reference at the last action [N]."""
    age: Number
    """Number of actions since the start."""
    active_cell: Number
    """Index of the cell whose policy is active."""
    blend: Number
    """Weight of the action one window ago in the next action; 0 without blending."""


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
    switching: SwitchingConfig = field(metadata=STATIC)
    gaits: GaitTable | None = None
    """Gaits to which all policies add their actions, if any."""

    @classmethod
    def load(
        cls,
        description: JsonObject,
        arrays: NamedArrays,
        limits: Limits,
        cells: Cells,
    ) -> tuple["GridStep", Cells]:
        """Build the step from a controller's description and arrays; return it with its cells."""
        if not cells:
            raise ValueError("cells: empty; a grid needs at least one cell")
        observation = PolicyObservation.from_description(description)
        switching = SwitchingConfig.model_validate(description.get("switching") or {})
        networks, gaits = fold(arrays, observation, (len(cells),))
        step = cls(
            networks, *cell_corners(cells), rest_action(limits), observation, switching, gaits
        )
        return step, cells

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
            last_reference=np.zeros(2, np.float32),
            age=0,
            active_cell=0,
            blend=np.float32(0),
        )

    def act(self, ops: Operations, state: GridState, now: Array) -> tuple[GridState, Array]:
        """Compute the deterministic action of the active policy, blended in after a switch."""
        xp = ops.xp
        reference = now[1:]
        active_cell = self.active_cell(ops, state, reference)
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
        memory = network.remember(
            ops, memory, self.observation.observe(ops, now, state.actions, state.age)
        )
        blend = self._blend(ops, state, switched, reference)
        own = network.action(ops, memory, self.gaits, reference, state.age)
        # Actions are pairs, newest first, so this is the action one full window ago.
        before = state.actions[2 * (self.window_actions - 1) : 2 * self.window_actions]
        action = (1 - blend) * own + blend * before
        less = blend - 1 / max(1, self.switching.fade_actions)
        after = GridState(
            *memory,
            actions=xp.concat([action, state.actions[:-2]]),
            angles=xp.concat([now[:1], state.angles[:-1]]),
            last_reference=reference,
            age=state.age + 1,
            active_cell=active_cell,
            blend=ops.clip(less, 0.0, 1.0),
        )
        return after, action

    def active_cell(self, ops: Operations, state: GridState, reference: Array) -> Number:
        """Return the index of the cell whose policy acts: the last one, unless another cell is
        nearer by more than the margin."""
        xp = ops.xp
        low = ops.constant(self.low)
        high = ops.constant(self.high)
        beyond = xp.maximum(xp.maximum(low - reference, reference - high), 0 * low)
        # Distance of the reference from each cell; 0 inside a cell.
        distance = xp.sqrt(beyond[:, 0] * beyond[:, 0] + beyond[:, 1] * beyond[:, 1])
        nearest = ops.whole(xp.argmin(distance))
        reach = ops.row(distance, nearest) + np.float32(self.switching.margin_n)
        stays = (state.age > 0) & (ops.row(distance, state.active_cell) <= reach)
        return ops.choose(stays, lambda: state.active_cell, lambda: nearest)

    def _warm_up_memory(
        self, ops: Operations, network: PolicyNetwork, state: GridState, reference: Array
    ) -> PolicyMemory:
        """Replay up to one window of past actions as if the present reference had been constant."""

        def replayed(memory: PolicyMemory, ago: int) -> PolicyMemory:
            now = ops.xp.concat([state.angles[ago - 1 : ago], reference])
            observation = self.observation.observe(
                ops, now, state.actions[2 * ago :], state.age - ago
            )
            return network.remember(ops, memory, observation)

        empty: PolicyMemory = ops.constant(network.empty())
        memory = empty
        if self.switching.replay:
            # Start with the oldest action; before the start of the episode, the memory stays empty.
            for ago in range(self.window_actions, 0, -1):
                memory = PolicyMemory(
                    *ops.choose(state.age >= ago, partial(replayed, memory, ago), lambda: empty)
                )
        return memory

    def _blend(
        self, ops: Operations, state: GridState, switched: Number, reference: Array
    ) -> Number:
        """Return the weight of the action one window ago; it starts at 1 at a switch, if a full
        window has passed since the start."""
        if not self.switching.fade_actions:
            return 0 * state.blend
        whole = ops.choose(
            state.age >= self.window_actions, lambda: np.float32(1), lambda: np.float32(0)
        )
        blend = ops.choose(switched, lambda: whole, lambda: state.blend)
        moved = reference - state.last_reference
        kept = 1 - ops.xp.sqrt(moved[0] * moved[0] + moved[1] * moved[1]) / np.float32(
            self.switching.step_n
        )
        return blend * ops.clip(kept, 0.0, 1.0)
