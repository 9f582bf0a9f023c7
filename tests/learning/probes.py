"""Plants that each test one part of the learner, and learners small enough for tests."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from softfin.core.action_clock import ActionClock
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Reading
from softfin.gaits.reachable import Cell
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPO, PPOConfig
from softfin.task.references import References
from softfin.task.task import ForceTracking, RewardConfig, TaskConfig

GAIN = 3.0

SMOOTH = RewardConfig(smoothness=(0.0, 0.0))


class LastAction(ActionClock):
    """The paper's clock, with a window that lies within the last action."""

    @property
    def window_ticks(self) -> int:
        return 32


class ProbeState(NamedTuple):
    actions: Any
    sign: Any
    force: Any
    """Of the command before."""


class Probe:
    """An action is one step, however many ticks it is held."""

    limits = PAPER_LIMITS

    def init(self, key: Any) -> ProbeState:
        return ProbeState(jnp.int32(0), jax.random.rademacher(key, (), jnp.float32), jnp.zeros(2))

    def hold_action(
        self, state: ProbeState, command: Command, ticks: Any, rows: int
    ) -> tuple[ProbeState, Reading]:
        return self.advance(state, command, rows)

    def advance(
        self, state: ProbeState, command: Command, ticks: int
    ) -> tuple[ProbeState, Reading]:
        angle, force = self.reading(state, command)
        return ProbeState(state.actions + 1, state.sign, commanded(command)), _reading(
            ticks, angle, force
        )

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        """Angle and force after an action."""
        raise NotImplementedError


class Direct(Probe):
    """The force is the commanded angle and velocity: no dynamics, nothing to remember."""

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        return jnp.float32(0), commanded(command)


class Delayed(Probe):
    """The force is what was commanded the action before: what is good to do shows only later."""

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        return jnp.float32(0), state.force


class Still(Probe):
    """No force whatever is done, so the reward is always the same."""

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        return jnp.float32(0), jnp.zeros(2)


class Late(Probe):
    """No force in the first three actions, (1, 0) N in all others, whatever is done; the angle
    counts the actions.

    From the fifth action on its states repeat on the clock, so an episode longer than that never
    bootstraps with one that no action is taken in.
    """

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        count = state.actions + 1
        return jnp.minimum(count, 4) / 2, jnp.where(count > 3, 1.0, 0.0) * jnp.array([1.0, 0.0])


class Recall(Probe):
    """A hidden sign, drawn at the start, turns the force; it shows once, as the angle after the
    first action.

    Where past actions are hidden, only memory can hold the reference.
    """

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        angle = jnp.where(state.actions == 0, state.sign, 0.0)
        return angle, jnp.stack([GAIN * state.sign * command.angle, jnp.float32(0)])


PROBES: tuple[type[Probe], ...] = (Direct, Delayed, Still, Late, Recall)


class AnyProbe(Probe):
    """That of `PROBES` with an index, which may be a value in a program: so one program holds them
    all."""

    def __init__(self, index: Any) -> None:
        self._index = index

    def reading(self, state: ProbeState, command: Command) -> tuple[Any, Any]:
        angles, forces = zip(*(probe().reading(state, command) for probe in PROBES), strict=True)
        return jnp.stack(angles)[self._index], jnp.stack(forces)[self._index]


def commanded(command: Command) -> Any:
    return jnp.stack([GAIN * command.angle, command.velocity])


def _reading(ticks: int, angle: Any, force: Any) -> Reading:
    ones = jnp.ones(ticks)
    return Reading(TICK_S * ones, angle * ones, 0 * ones, ones[:, None] * force)


def learner(
    plant: Any, updates: int, episode: int = 12, past_actions: int = 0, **changes: Any
) -> PPO:
    task = TaskConfig(
        clock=LastAction(),
        episode_actions=episode,
        reference_actions=episode,
        past_actions=past_actions,
        reward=SMOOTH,
    )
    config = PPOConfig(
        **{
            "num_envs": 16,
            "num_steps": episode,
            "num_epochs": 8,
            "num_minibatches": 4,
            "final_learning_rate": 0.1,
            **changes,
        }
    )
    return PPO(ForceTracking(plant, task), config, PolicyConfig(units=16, width=16), updates)


def box(low: tuple[float, float], high: tuple[float, float]) -> References:
    return References.of(Cell(low=low, high=high))
