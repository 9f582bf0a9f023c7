"""The slow outer loop about any controller: what the fin makes besides what was asked for is taken off the reference.

A disturbance observer (Ohnishi 1987; Sariyildiz, Oboe and Ohnishi 2020) that acts through the reference, held within
the controller's range and the fin's reach. Plain numbers: there are two axes and six actions.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from softfin.control.native.operations import Array
from softfin.core.action_clock import ACTION_TICKS, CYCLE_ACTIONS, WINDOW
from softfin.gaits.region import Box, Pair, Region


@runtime_checkable
class TrimSettings(Protocol):
    """The numbers of the outer loop, as softfin.control.trim.TrimConfig has them."""

    @property
    def gain(self) -> float:
        """Part of the difference that is taken over each action."""
        ...

    @property
    def lag_actions(self) -> int:
        """Actions until the force follows what was asked."""
        ...

    @property
    def settle_actions(self) -> int:
        """Actions from rest during which nothing is learnt."""
        ...

    @property
    def still_n(self) -> float:
        """The reference counts as at rest while it moves by less than this within the window [N]."""
        ...

    @property
    def limit_n(self) -> float:
        """The trim of each axis stays within this [N]."""
        ...


class Trim(NamedTuple):
    """The same numbers where there is no pydantic; defaults as there."""

    gain: float = 0.15
    lag_actions: int = 1
    settle_actions: int = 8
    still_n: float = 0.1
    limit_n: float = 1.0


class TrimState(NamedTuple):
    """Of the loop and of what is inside it; the newest first."""

    inner: Any
    bias: Pair
    """What the fin makes besides what is asked [N]."""
    forces: tuple[Pair, ...]
    """Mean force while each of the last six actions was held [N]."""
    asked: tuple[Pair, ...]
    """What the inner controller was asked for then [N]."""
    wanted: tuple[Pair, ...]
    """The references then, untrimmed [N]."""
    age: int
    """Actions since the start."""


@runtime_checkable
class Acting(Protocol):
    """What turns measurements into a normalised action."""

    def init(self) -> Any:
        """The state before the first action."""
        ...

    def act(self, state: Any, angle: float, force: Pair, reference: Pair) -> tuple[Any, Array]:
        """The next action."""
        ...


@dataclass(frozen=True)
class Trimmed:
    """Meets the Acting contract, about another one."""

    inner: Acting
    settings: TrimSettings
    box: Box
    """Round all cells of the controller."""
    region: Region | None

    def init(self) -> TrimState:
        """Nothing known of any bias."""
        nothing = ((0.0, 0.0),) * (CYCLE_ACTIONS + self.settings.lag_actions)
        return TrimState(self.inner.init(), (0.0, 0.0), nothing[:CYCLE_ACTIONS], nothing, nothing, 0)

    def act(self, state: TrimState, angle: float, force: Pair, reference: Pair) -> tuple[TrimState, Array]:
        """The inner controller's action for the reference less the bias."""
        forces = (force, *state.forces[:-1])
        bias = self._bias(state, forces)
        asked = self._within((reference[0] - bias[0], reference[1] - bias[1]))
        inner, action = self.inner.act(state.inner, angle, force, asked)
        after = TrimState(
            inner, bias, forces, (asked, *state.asked[:-1]), (reference, *state.wanted[:-1]), state.age + 1
        )
        return after, action

    def _bias(self, state: TrimState, forces: tuple[Pair, ...]) -> Pair:
        settings = self.settings
        if state.age < settings.settle_actions:
            return state.bias
        # While the reference moves, the fin's own lag looks like a bias: then little is learnt.
        moved = max(max(axis) - min(axis) for axis in zip(*state.wanted, strict=True))
        gain = settings.gain * min(1.0, settings.still_n / max(moved, 1e-6)) ** 2
        # Ticks of the last six actions, newest first: the action before this one was number age - 1.
        held = [ACTION_TICKS[(state.age - 1 - ago) % len(ACTION_TICKS)] for ago in range(CYCLE_ACTIONS)]
        asked = state.asked[-CYCLE_ACTIONS:]
        x, y = (
            sum(ticks * (f[i] - a[i]) for ticks, f, a in zip(held, forces, asked, strict=True)) / WINDOW
            for i in range(2)
        )
        limit = settings.limit_n
        bx, by = (
            min(max(old + gain * (surplus - old), -limit), limit)
            for old, surplus in zip(state.bias, (x, y), strict=True)
        )
        return bx, by

    def _within(self, reference: Pair) -> Pair:
        """The trimmed reference, brought back to the controller's range and the fin's reach, where known."""
        inside = self.box.clipped(reference)
        return inside if self.region is None else self.region.pulled(inside)
