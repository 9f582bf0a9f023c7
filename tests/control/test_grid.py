"""Switching between the policies of a grid: when it happens, and that it is not felt where little
has changed."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.control.controller import Controller, LoadedController, Measured
from softfin.control.grid import GridState, GridStep, SwitchingConfig
from softfin.control.policy import PolicyNetwork
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.operations import NUMPY
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.reachable import Cell
from softfin.learning.policy import Policy, PolicyConfig, name_policy_arrays
from softfin.task.references import lattice
from softfin.task.task import TaskConfig

TASK = TaskConfig(phase=True)
SIZE = PolicyConfig(units=8, width=8)
TWO = lattice(2, 1, Cell(low=(0, -1), high=(2, 1)))
"""The border is at x = 1 N."""
HAIR = 0.005
COLD = SwitchingConfig(margin_n=0, fade_actions=0, replay=False)
AT_ONCE = SwitchingConfig(margin_n=0)
FADELESS = SwitchingConfig(margin_n=0, fade_actions=0)
SETTLED = 36


@functools.partial(jax.jit, static_argnames="cells")
def policies(cells: int, apart: float) -> Policy:
    """Random policies that beat with the clock and forget within a cycle; `apart` is how much
    neighbours differ."""

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


def grid(
    switching: SwitchingConfig, apart: float = 0.1, cells: tuple[Cell, ...] = TWO
) -> LoadedController:
    arrays = {
        name: np.asarray(leaf)
        for name, leaf in name_policy_arrays(policies(len(cells), apart)).items()
    }
    return controller_of(arrays, switching, cells)


def controller_of(
    arrays: Any, switching: SwitchingConfig, cells: tuple[Cell, ...]
) -> LoadedController:
    task = TASK.model_dump()
    switched = switching.model_dump()
    step, _ = GridStep.load({"task": task, "switching": switched}, arrays, PAPER_LIMITS, cells)
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


def crossing(switching: SwitchingConfig, apart: float) -> Float[np.ndarray, "actions"]:
    """How far the commanded angle is from what it is without a switch, from the crossing of the
    border on [rad]."""
    stay = [1 - HAIR] * (SETTLED + 12)
    cross = [1 - HAIR] * SETTLED + [1 + HAIR] * 12
    (quiet, _) = play(grid(switching, apart), stay)
    (crossed, states) = play(grid(switching, apart), cross)
    assert cells_of(states[SETTLED - 1 : SETTLED + 1]) == [0, 1]
    return np.asarray(np.abs(crossed - quiet)[SETTLED:, 0])


def test_the_state_is_arrays_and_numbers_alone() -> None:
    controller = grid(SwitchingConfig())
    assert isinstance(controller, Controller)
    assert all(
        isinstance(leaf, int | np.ndarray | np.generic)
        for leaf in jax.tree.leaves(controller.init())
    )


def test_the_policies_here_beat_with_the_clock() -> None:
    angle = play(grid(COLD), [1 - HAIR] * (SETTLED + 12))[0][-12:, 0]
    assert np.ptp(angle) > 0.3
    np.testing.assert_allclose(angle[:6], angle[6:], atol=0.02)


def test_crossing_a_border_by_a_hair_is_not_felt_in_the_command_though_the_policies_differ() -> (
    None
):
    assert crossing(COLD, 0.1)[0] > 0.2
    assert crossing(AT_ONCE, 0.1)[0] < 0.02


def test_the_new_policy_comes_in_by_a_sixth_an_action() -> None:
    faded = crossing(AT_ONCE, 0.1)
    gap = crossing(FADELESS, 0.1).max()
    assert gap > 0.1
    assert (
        faded[: PAPER_CLOCK.window_actions]
        < 0.01 + gap * np.arange(PAPER_CLOCK.window_actions) / PAPER_CLOCK.window_actions
    ).all()
    assert faded[PAPER_CLOCK.window_actions :].max() > 0.1


def test_between_policies_that_are_the_same_a_switch_does_nothing() -> None:
    assert crossing(COLD, 0.0)[0] > 0.1
    assert crossing(FADELESS, 0.0).max() < 0.02


def test_in_the_first_cycle_the_new_policy_remembers_all_as_if_it_had_been_in_charge() -> None:
    near = 1 - 1e-5
    far = 1 + 1e-5
    for before in (1, 3, PAPER_CLOCK.window_actions):
        switched, stayed = (
            play(grid(FADELESS, 0.0), [near] * before + [last])[1][-1] for last in (far, near)
        )
        assert (int(switched.active_cell), int(stayed.active_cell)) == (1, 0)
        np.testing.assert_allclose(switched.cell, stayed.cell, atol=1e-4)
        np.testing.assert_allclose(switched.actions, stayed.actions, atol=1e-3)


def test_a_switch_at_the_second_action_replays_the_first_one() -> None:
    reference = np.array([1 + HAIR, 0], np.float32)
    controller = grid(FADELESS)
    commands, states = play(controller, [1 - HAIR, 1 + HAIR])
    assert cells_of(states) == [0, 1]
    step = controller.step
    assert isinstance(step, GridStep)
    network = PolicyNetwork(*[part[1] for part in step.networks])
    at_rest = step.observation.observe(
        NUMPY, np.append(np.float32(0), reference), step.init().actions, 0
    )
    moved = step.observation.observe(
        NUMPY, np.append(commands[0, 0], reference), np.asarray(states[0].actions), 1
    )
    memory = network.empty()
    for observation in (at_rest, moved):
        memory = network.remember(NUMPY, memory, observation)
    np.testing.assert_allclose(states[1].cell, memory.cell, atol=1e-5)
    np.testing.assert_allclose(states[1].hidden, memory.hidden, atol=1e-5)


def test_the_policy_in_charge_stays_a_little_beyond_its_cell() -> None:
    wander = [0.95, 1.05, 1.09, 0.99, 1.08]
    assert cells_of(play(grid(SwitchingConfig()), wander)[1]) == [0] * 5
    assert cells_of(play(grid(AT_ONCE), wander)[1]) == [0, 1, 1, 0, 1]
    assert cells_of(play(grid(SwitchingConfig()), [0.95, 1.11, 0.95, 0.91, 0.89])[1]) == [
        0,
        1,
        1,
        1,
        0,
    ]


def test_the_first_action_is_that_of_the_references_own_cell() -> None:
    assert cells_of(play(grid(SwitchingConfig()), [1.05])[1]) == [1]


def test_in_a_gap_the_cell_that_is_nearer_by_more_than_the_margin_is_in_charge() -> None:
    apart = (Cell(low=(0, -1), high=(1, 1)), Cell(low=(2, -1), high=(3, 1)))
    states = play(grid(SwitchingConfig(), cells=apart), [0.5, 1.5, 1.54, 1.56, 1.5, 9.0])[1]
    assert cells_of(states) == [0, 0, 0, 1, 1, 1]


def test_after_a_step_the_new_policy_is_alone_at_once() -> None:
    x = [0.5] * SETTLED + [1.5] * 3
    stepped, states = play(grid(SwitchingConfig()), x)
    alone = play(grid(SwitchingConfig(fade_actions=0)), x)[0]
    np.testing.assert_allclose(stepped, alone, atol=1e-5)
    assert cells_of(states[-3:]) == [1, 1, 1]


def test_a_step_ends_a_fade_that_has_begun() -> None:
    states = play(grid(AT_ONCE), [1 - HAIR] * SETTLED + [1 + HAIR] * 2 + [1.9] * 2)[1]
    np.testing.assert_allclose(
        [state.blend for state in states[-4:]], [5 / 6, 4 / 6, 0, 0], atol=0.03
    )


def test_commands_stay_within_the_limits_during_a_fade() -> None:
    controller = grid(AT_ONCE, 0.5)
    commands = play(controller, ([1 - HAIR] * 7 + [1 + HAIR] * 7) * 2)[0]
    low = PAPER_LIMITS[::2]
    high = PAPER_LIMITS[1::2]
    assert (commands >= np.asarray(low)).all()
    assert (commands <= np.asarray(high)).all()


def test_many_references_at_once_are_as_each_alone() -> None:
    controller = grid(AT_ONCE)
    rows = [[1 - HAIR] * 7 + [1 + HAIR, 1 + HAIR], [0.5] * 9]
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
        cells = lattice(columns, columns, Cell(low=(0, -1), high=(2, 1)))

        shapes = jax.eval_shape(functools.partial(policies, len(cells)), 0.1)
        arrays = {
            name: np.zeros(leaf.shape, np.float32)
            for name, leaf in name_policy_arrays(shapes).items()
        }
        controller = controller_of(arrays, SwitchingConfig(), cells)
        now = (controller.init(), Measured(jnp.float32(0), jnp.zeros(2)), jnp.zeros(2))
        cost: Any = (
            jax.jit(lambda controller, *now: controller.act(*now))
            .lower(controller, *now)
            .cost_analysis()
        )
        return float(cost["flops"])

    assert operations(8) < 1.3 * operations(2)
