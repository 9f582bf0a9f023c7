"""Runs controllers that JAX cannot compile: any Python object, and policies of other libraries.

All experiments run in lock step, action by action: the controller acts in Python for each of them,
then one compiled program moves all fins.
"""

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from softfin.control.controller import Controller, Measured, controller_clock
from softfin.control.pytrees import register_controllers
from softfin.control.references import check_within, controller_cells, reachable_set
from softfin.core.action_clock import ActionClock
from softfin.core.compilation import jit
from softfin.core.errors import RunError
from softfin.core.operations import NUMPY
from softfin.core.plant import Plant, State, Ticks, check_commands
from softfin.core.quantities import Command, Limits, action_to_command
from softfin.evaluation.experiment import (
    LoopRecording,
    Program,
    add_power,
    hold_once,
    measure,
    measure_at_rest,
    run_compiled,
)
from softfin.gaits.reachable import ForceVector
from softfin.task.task import TaskConfig, rest_actions


@runtime_checkable
class PredictPolicy(Protocol):
    """A policy that learnt in softfin's Gymnasium environment, such as a model of
    stable-baselines3 or sb3-contrib.

    The optional attribute `task` is the `TaskConfig` of its environment; `cells` and `reachable`
    are as for a `Controller`.
    """

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[Any, Any]:
        """Return the actions for observations ``(1, observations)`` and the next state, which is
        None before the first action."""
        ...


class PredictState(NamedTuple):
    """State of a `PolicyController`."""

    memory: Any
    """State of the policy; None before the first action."""
    actions: Float[np.ndarray, "numbers"]
    """Past actions, newest first."""
    is_first: bool


class PolicyController:
    """A policy with `predict` as a `Controller`, in the units of the `limits` that it learnt in."""

    kind = "policy"

    def __init__(
        self, policy: PredictPolicy, limits: Limits, task: TaskConfig | None = None
    ) -> None:
        self.policy = policy
        self.limits = limits
        self.task = task or getattr(policy, "task", None) or TaskConfig()
        self.clock = self.task.clock
        self.cells = controller_cells(policy)
        self.reachable = reachable_set(policy)

    def init(self) -> PredictState:
        """Return the state before the first action."""
        actions = np.asarray(rest_actions(self.task, self.limits)).reshape(-1)
        return PredictState(None, actions, True)

    def act(
        self, state: PredictState, measured: Measured, reference: Any
    ) -> tuple[PredictState, Command]:
        """Return the command of the policy's deterministic action; raises RunError if the action is
        not two numbers in [-1, 1]."""
        now = np.array([measured.angle, *reference])
        observed = self.task.observation.observe_scaled(NUMPY, now, state.actions)
        predicted, memory = self.policy.predict(
            observed[None].astype(np.float32),
            state=state.memory,
            episode_start=np.array([state.is_first]),
            deterministic=True,
        )
        action = np.asarray(predicted, float).reshape(-1)
        # Negated, so that NaN is refused.
        if action.shape != (2,) or not (abs(action) <= 1).all():
            raise RunError(
                f"{type(self.policy).__name__}: action {predicted} must be two numbers in [-1, 1]; "
                "clip it or squash it"
            )
        actions = np.concatenate([action, state.actions[:-2]])
        return PredictState(memory, actions, False), action_to_command(self.limits, action)

    def check(self, reference: ForceVector) -> None:
        """Raise CoverageError if the policy has cells and the reference [N] is outside them."""
        if self.cells:
            check_within(self.cells, reference)


def choose_program(controller: Controller) -> Program:
    """Return `run_compiled` if JAX can take the controller as an argument, i.e. if it is a pytree
    of arrays and numbers; otherwise `run_in_python`."""
    register_controllers()
    leaves = jax.tree.leaves(controller)
    return run_compiled if all(map(eqx.is_array_like, leaves)) else run_in_python


def run_in_python(
    parties: tuple[Controller, Plant],
    references: Float[Array, "references actions 2"],
    keys: Key[Array, "seeds"],
) -> LoopRecording:
    """Run experiments like `run_compiled`, with a controller that runs in Python.

    Raises CommandError if a command is outside the limits of the plant.
    """
    controller, plant = parties
    clock = controller_clock(controller)
    count, actions, _ = references.shape
    asked = np.repeat(np.asarray(references), len(keys), axis=0)
    memories = [controller.init() for _ in asked]
    states, measured = _start(plant, clock, jnp.tile(keys, count))
    estimate = getattr(controller, "estimate", None)
    kept = []
    estimates = []
    for index, ticks in enumerate(clock.action_ticks(actions)):
        seen = jax.tree.map(np.asarray, measured)
        commands = []
        for run, reference in enumerate(asked[:, index]):
            own = jax.tree.map(lambda part, run=run: part[run], seen)
            memories[run], command = controller.act(memories[run], own, reference)
            commands.append(command)
        angle, velocity = np.array(commands, np.float32).T
        command = Command(jnp.asarray(angle), jnp.asarray(velocity))
        check_commands(plant.limits, command)
        states, measured, held = _hold(plant, clock, states, command, jnp.int32(ticks))
        kept.append(jax.tree.map(np.asarray, held))
        if estimate is not None:
            estimates.append(_stack([estimate(memory) for memory in memories]))

    def together(*parts: Any) -> Any:
        rows = np.concatenate(parts, axis=1)
        return rows.reshape(count, len(keys), *rows.shape[1:])

    def valid(*parts: Any) -> Any:
        return together(*parts)[:, :, clock.valid_rows(actions)]

    recorded = LoopRecording(*jax.tree.map(valid, *kept), None)
    recorded = jax.vmap(jax.vmap(add_power))(recorded)
    if not estimates:
        return recorded
    each = [jax.tree.map(lambda part: part[:, None], after) for after in estimates]
    return recorded._replace(estimate=jax.tree.map(together, *each))


def _stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *parts: np.stack(parts), *trees)


@jit("low")
def _start(plant: Plant, clock: ActionClock, keys: Key[Array, "runs"]) -> tuple[State, Measured]:
    def one(key: Key[Array, ""]) -> tuple[State, Measured]:
        state = plant.init(key)
        return state, measure_at_rest(plant, state, partial(hold_once, plant, clock))

    return jax.vmap(one)(keys)


@jit("low")
def _hold(
    plant: Plant, clock: ActionClock, states: State, commands: Command, ticks: Ticks
) -> tuple[State, Measured, Any]:
    """Hold one command on each fin; also return its measurements, and the command, readings and
    hidden quantities of each tick."""

    def one(state: State, command: Command) -> tuple[State, Measured, Any]:
        state, (reading, torque, hidden) = hold_once(plant, clock, state, command, ticks)
        held = jax.tree.map(lambda x: jnp.full(clock.max_ticks, x), command)
        return state, measure(reading, torque, ticks), (held, reading, hidden)

    return jax.vmap(one)(states, commands)
