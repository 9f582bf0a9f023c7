"""Plants that each test one part of the learner, and learners small enough for tests."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from softfin.quantities import PAPER_LIMITS, TICK_S, Command, Reading
from softfin.tracking.references import Cell, References
from softfin.tracking.task import ForceTracking, RewardConfig, TaskConfig
from softfin.training.policy import PolicyConfig
from softfin.training.ppo import PPO, PPOConfig

GAIN = 3.0
SMOOTH = RewardConfig(smoothness=(0.0, 0.0))


class ProbeState(NamedTuple):
    actions: Any
    sign: Any


class Direct:
    """The force is the commanded angle and velocity: no dynamics, nothing to remember."""

    limits = PAPER_LIMITS

    def init(self, key: Any) -> ProbeState:
        return ProbeState(jnp.int32(0), jnp.float32(1))

    def advance(self, state: ProbeState, command: Command, ticks: int) -> tuple[ProbeState, Reading]:
        force = jnp.stack([GAIN * command.angle, command.velocity])
        return state._replace(actions=state.actions + 1), _reading(ticks, jnp.float32(0), force)


class Delayed(Direct):
    """The force is what was commanded the action before: what is good to do shows only later."""

    def init(self, key: Any) -> Any:
        return jnp.zeros(2)

    def advance(self, state: Any, command: Command, ticks: int) -> tuple[Any, Reading]:
        return jnp.stack([GAIN * command.angle, command.velocity]), _reading(ticks, jnp.float32(0), state)


class Still(Direct):
    """No force whatever is done, so the reward is always the same."""

    def advance(self, state: ProbeState, command: Command, ticks: int) -> tuple[ProbeState, Reading]:
        return state._replace(actions=state.actions + 1), _reading(ticks, jnp.float32(0), jnp.zeros(2))


class Late(Direct):
    """No force in the first three actions, (1, 0) N in all others, whatever is done; the angle counts the actions.

    From the fifth action on its states repeat on the clock, so an episode longer than that never bootstraps with one
    that no action is taken in.
    """

    def advance(self, state: ProbeState, command: Command, ticks: int) -> tuple[ProbeState, Reading]:
        count = state.actions + 1
        force = jnp.where(count > 3, 1.0, 0.0) * jnp.array([1.0, 0.0])
        return state._replace(actions=count), _reading(ticks, jnp.minimum(count, 4) / 2, force)


class Recall:
    """A hidden sign, drawn at the start, turns the force; it shows once, as the angle after the first action.

    Where past actions are hidden, only memory can hold the reference.
    """

    limits = PAPER_LIMITS

    def init(self, key: Any) -> ProbeState:
        return ProbeState(jnp.int32(0), jax.random.rademacher(key, (), jnp.float32))

    def advance(self, state: ProbeState, command: Command, ticks: int) -> tuple[ProbeState, Reading]:
        angle = jnp.where(state.actions == 0, state.sign, 0.0)
        force = jnp.stack([GAIN * state.sign * command.angle, jnp.float32(0)])
        return state._replace(actions=state.actions + 1), _reading(ticks, angle, force)


def _reading(ticks: int, angle: Any, force: Any) -> Reading:
    ones = jnp.ones(ticks)
    return Reading(TICK_S * ones, angle * ones, 0 * ones, ones[:, None] * force)


def learner(plant: Any, updates: int, episode: int = 12, past_actions: int = 0, **changes: Any) -> PPO:
    task = TaskConfig(
        window_samples=32, episode_actions=episode, reference_actions=episode, past_actions=past_actions, reward=SMOOTH
    )
    config = PPOConfig(**{"environments": 16, "rollout_actions": episode, "epochs": 8, **changes})
    return PPO(ForceTracking(plant, task), config, PolicyConfig(units=16, width=16), updates)


def box(low: tuple[float, float], high: tuple[float, float]) -> References:
    return Cell(low=low, high=high).references()
