"""Switching between the policies of a grid: when it happens, and what the new policy remembers."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.control.controller import Controller, LoadedController, Measured
from softfin.control.grid import GridState, GridStep
from softfin.control.policy import PolicyNetwork
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.operations import NUMPY
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.reachable import Cell
from softfin.learning.policy import Policy, PolicyConfig, name_policy_arrays
from softfin.task.references import divide
from softfin.task.task import TaskConfig

TASK = TaskConfig()
SIZE = PolicyConfig(units=8, width=8)
TWO = divide(Cell(low=(0, -1), high=(2, 1)), 2, 1)
"""The border is at x = 1 N."""


@functools.partial(jax.jit, static_argnames="cells")
def policies(cells: int, apart: float) -> Policy:
    """Random policies that forget within a cycle; `apart` is how much neighbours differ."""

    def random(key: Any) -> Policy:
        policy: Policy = Policy.create(key, SIZE, TASK.observations)
        return policy

    first, *others = jax.random.split(jax.random.key(2), cells + 1)
    mixed: Policy = jax.tree.map(
        lambda mean, own: mean + apart * own, random(first), jax.vmap(random)(jnp.stack(others))
    )
    net = mixed.net
    forgetful: Policy = eqx.tree_at(
        lambda policy: (policy.net.lstm.recurrent, policy.net.lstm.bias, policy.net.output.kernel),
        mixed,
        (0.5 * net.lstm.recurrent, 0 * net.lstm.bias, 150 * net.output.kernel),
    )
    return forgetful


def grid(apart: float = 0.1, cells: tuple[Cell, ...] = TWO) -> LoadedController:
    arrays = {
        name: np.asarray(leaf)
        for name, leaf in name_policy_arrays(policies(len(cells), apart)).items()
    }
    return controller_of(arrays, cells)


def controller_of(arrays: Any, cells: tuple[Cell, ...]) -> LoadedController:
    description = {"task": TASK.model_dump(), "clock": PAPER_CLOCK.model_dump()}
    step, _ = GridStep.load(description, arrays, PAPER_LIMITS, cells)
    return LoadedController(step, PAPER_LIMITS, cells)


@eqx.filter_jit
def act(controller: LoadedController, state: Any, angle: Array, reference: Array) -> Any:
    state, command = controller.act(state, Measured(angle, jnp.zeros(2)), reference)
    return state, jnp.stack(command)


def play(
    controller: LoadedController, x: list[float]
) -> tuple[Float[np.ndarray, "actions 2"], list[GridState]]:
    """Commands for references (x, 0) N, the shaft where the last command sent it; and the states
    behind them."""
    state = jax.tree.map(jnp.array, controller.init())
    angle = jnp.float32(0)
    commands = []
    states = []
    for asked in x:
        state, command = act(controller, state, angle, jnp.array([asked, 0], jnp.float32))
        angle = command[0]
        commands.append(np.asarray(command))
        states.append(state)
    return np.stack(commands), states


def cells_of(states: list[GridState]) -> list[int]:
    return [int(state.active_cell) for state in states]


def test_the_state_is_arrays_and_numbers_alone() -> None:
    controller = grid()
    assert isinstance(controller, Controller)
    assert all(
        isinstance(leaf, int | np.ndarray | np.generic)
        for leaf in jax.tree.leaves(controller.init())
    )


def test_the_policy_of_the_references_cell_acts() -> None:
    assert cells_of(play(grid(), [1.05, 0.95, 0.5, 1.001, 9.0, -9.0])[1]) == [1, 0, 0, 1, 1, 0]


def test_in_a_gap_the_policy_of_the_nearest_cell_acts() -> None:
    apart = (Cell(low=(0, -1), high=(1, 1)), Cell(low=(2, -1), high=(3, 1)))
    states = play(grid(cells=apart), [0.5, 1.4, 1.6, 2.5, 1.4])[1]
    assert cells_of(states) == [0, 0, 1, 1, 0]


def test_the_new_policy_remembers_all_as_if_it_had_been_active() -> None:
    near = 1 - 1e-5
    far = 1 + 1e-5
    for before in (1, 3, PAPER_CLOCK.window_actions):
        switched, stayed = (
            play(grid(0.0), [near] * before + [last])[1][-1] for last in (far, near)
        )
        assert (int(switched.active_cell), int(stayed.active_cell)) == (1, 0)
        np.testing.assert_allclose(switched.cell, stayed.cell, atol=1e-4)
        np.testing.assert_allclose(switched.actions, stayed.actions, atol=1e-3)


def test_a_switch_at_the_second_action_replays_the_first_one() -> None:
    reference = np.array([1.01, 0], np.float32)
    controller = grid()
    commands, states = play(controller, [0.99, 1.01])
    assert cells_of(states) == [0, 1]
    step = controller.step
    assert isinstance(step, GridStep)
    network = PolicyNetwork(*[part[1] for part in step.networks])
    at_rest = step.observation.observe(
        NUMPY, np.append(np.float32(0), reference), step.init().actions
    )
    moved = step.observation.observe(
        NUMPY, np.append(commands[0, 0], reference), np.asarray(states[0].actions)
    )
    memory = network.empty()
    for observation in (at_rest, moved):
        memory = network.remember(NUMPY, memory, observation)
    np.testing.assert_allclose(states[1].cell, memory.cell, atol=1e-5)
    np.testing.assert_allclose(states[1].hidden, memory.hidden, atol=1e-5)


def test_many_references_at_once_are_as_each_alone() -> None:
    controller = grid()
    rows = [[0.99] * 7 + [1.01, 1.01], [0.5] * 9]
    states = jax.tree.map(lambda x: jnp.stack([x, x]), controller.init())
    side_by_side = jax.jit(lambda *now: jax.vmap(lambda *one: controller.act(*one))(*now))
    together = []
    for now in zip(*rows, strict=True):
        references = jnp.array([[x, 0] for x in now], jnp.float32)
        states, command = side_by_side(
            states, Measured(jnp.zeros(2), jnp.zeros((2, 2))), references
        )
        together.append(np.stack(command, axis=-1))
    for index, row in enumerate(rows):
        state = controller.init()
        for x, expected in zip(row, together, strict=True):
            state, command = act(controller, state, jnp.float32(0), jnp.array([x, 0], jnp.float32))
            np.testing.assert_allclose(command, expected[index], atol=1e-5)


def test_an_action_costs_the_same_for_any_number_of_cells() -> None:
    """Counted in the program; nothing is compiled."""

    def operations(columns: int) -> float:
        cells = divide(Cell(low=(0, -1), high=(2, 1)), columns, columns)
        shapes = jax.eval_shape(functools.partial(policies, len(cells)), 0.1)
        arrays = {
            name: np.zeros(leaf.shape, np.float32)
            for name, leaf in name_policy_arrays(shapes).items()
        }
        controller = controller_of(arrays, cells)
        now = (controller.init(), Measured(jnp.float32(0), jnp.zeros(2)), jnp.zeros(2))
        cost: Any = (
            jax.jit(lambda controller, *now: controller.act(*now))
            .lower(controller, *now)
            .cost_analysis()
        )
        return float(cost["flops"])

    assert operations(8) < 1.3 * operations(2)
