"""Gaits as a controller."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.controller import Controller, LoadedController, Measured
from softfin.control.feedback import Feedback
from softfin.control.gait import GaitStep
from softfin.control.pytrees import register_controllers
from softfin.control.store import load_controller
from softfin.core.errors import CoverageError
from softfin.core.quantities import PAPER_LIMITS, action_to_command
from tests.gaits.known import KNOWN, TABLE, save_known

register_controllers()

STEP, CELLS = GaitStep.load(KNOWN.to_dict(), KNOWN.arrays(), PAPER_LIMITS, ())
CONTROLLER = LoadedController(STEP, PAPER_LIMITS, CELLS, KNOWN.reachable)


def commands(references: Any) -> np.ndarray:
    def act(state: Any, reference: Any) -> Any:
        state, command = CONTROLLER.act(state, Measured(jnp.float32(0), jnp.ones(2)), reference)
        return state, jnp.stack(command)

    return np.asarray(jax.jit(lambda r: jax.lax.scan(act, CONTROLLER.init(), r)[1])(references))


def expected(actions: Any) -> np.ndarray:
    return np.stack([action_to_command(PAPER_LIMITS, action) for action in jnp.asarray(actions)])


def test_it_meets_the_contract() -> None:
    assert isinstance(CONTROLLER, Controller)


def test_at_a_node_it_plays_the_six_actions_again_and_again() -> None:
    found = commands(jnp.tile(jnp.array([1.5, 0.0]), (12, 1)))
    np.testing.assert_allclose(found[:6], expected(TABLE.actions[1, 1]), atol=1e-4)
    np.testing.assert_array_equal(found[6:], found[:6])


def test_the_phase_goes_on_when_the_reference_moves() -> None:
    references = jnp.array([[0.5, -1.0]] * 4 + [[2.5, 2.0]] * 5)
    found = commands(references)
    np.testing.assert_allclose(found[:4], expected(TABLE.actions[0, 0, :4]), atol=1e-4)
    np.testing.assert_allclose(found[4:6], expected(TABLE.actions[-1, -1, 4:]), atol=1e-4)
    np.testing.assert_allclose(found[6:], expected(TABLE.actions[-1, -1, :3]), atol=1e-4)


def test_it_covers_its_lattice_and_no_more() -> None:
    CONTROLLER.check((0.5, 2.0))
    assert CONTROLLER.cells[0].high == (2.5, 2.0)
    with pytest.raises(CoverageError, match=r"\(3, 0\) N: 0\.5 N outside"):
        CONTROLLER.check((3.0, 0.0))


def test_a_gait_controller_with_an_observer_acts_within_a_compiled_program() -> None:
    observed = Feedback(CONTROLLER)
    measured = Measured(jnp.float32(0), jnp.zeros(2))
    reference = jnp.asarray([1.0, 0.0])
    act = jax.jit(lambda controller, state: controller.act(state, measured, reference)[1])
    compiled = act(observed, observed.init())
    eager = observed.act(observed.init(), measured, reference)[1]
    np.testing.assert_allclose(compiled.angle, eager.angle, atol=1e-6)
    np.testing.assert_allclose(compiled.velocity, eager.velocity, atol=1e-6)


def test_a_map_comes_back_from_its_folder_as_a_controller(tmp_path: Path) -> None:
    again = load_controller(save_known(tmp_path / "gaits"))
    assert isinstance(again.step, GaitStep)
    jax.tree.map(np.testing.assert_array_equal, again.step.table, TABLE)
    assert again.reachable is not None
    np.testing.assert_allclose(again.reachable.corners(), KNOWN.reachable.corners(), atol=1e-4)
    assert again.limits == PAPER_LIMITS


def test_the_folder_says_where_it_is_from(tmp_path: Path) -> None:
    folder = save_known(tmp_path / "gaits", more={"a": 1})
    description = json.loads((folder / "controller.json").read_text())
    assert description["controller"] == "gaits"
    assert description["provenance"] == {"plant": "mine"}
    assert description["more"] == {"a": 1}
