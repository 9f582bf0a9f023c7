"""Controllers: they act as their policies do in the task, cover what they were trained for, and
come back from disk."""

import json
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.controller import Controller, LoadedController, Measured
from softfin.control.grid import GridStep
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import CoverageError
from softfin.core.operations import NUMPY
from softfin.core.quantities import PAPER_LIMITS, action_to_command
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, Reachable
from softfin.learning.configuration import (
    GRID,
    SINGLE,
    TrainConfig,
    evaluation_references,
    training_cells,
)
from softfin.learning.controllers import save_policies
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.train import TrainedPolicies
from softfin.task.references import References
from softfin.task.task import ForceTracking
from tests.plants import AnalyticFin

SIZE = PolicyConfig(units=8, width=8)
WIDE = Reachable(np.array([2, 0], np.float32), np.full(32, 4, np.float32))
"""A fin that can produce all of the paper's references."""
SCORED = {"step": 960, "reward": -1.0, "score_x_n": 0.2, "score_y_n": 0.3}
LOG = [{"step": 480, "reward": -2.0}, SCORED]


def untrained(config: TrainConfig) -> TrainedPolicies:
    """As if trained: loud random policies."""
    config = config.model_copy(update={"policy": SIZE, "range": "paper"})
    cells = training_cells(config, WIDE)
    keys = jax.random.split(jax.random.key(0), len(cells))
    policies = jax.jit(jax.vmap(lambda key: Policy.create(key, SIZE, 11)))(keys)
    loud = jax.tree.map(lambda x: jnp.asarray(3 * np.asarray(x)), policies)
    shape = (len(cells), config.lattice**2, 2)
    evaluation = PolicyEvaluation(jnp.full(shape, 0.25), jnp.full(shape, 0.5))
    references = evaluation_references(config, cells, WIDE)
    return TrainedPolicies(
        config, config.task, cells, WIDE, PAPER_LIMITS, loud, references, evaluation, LOG
    )


def controller_of(trained: TrainedPolicies) -> LoadedController:
    with tempfile.TemporaryDirectory() as folder:
        save_policies(Path(folder) / "controller", trained, {}, {})
        return load_controller(Path(folder) / "controller")


GRID_RUN = untrained(GRID)
SINGLE_RUN = untrained(SINGLE)


@pytest.fixture(params=[SINGLE_RUN, GRID_RUN], ids=["single", "grid"])
def run(request: pytest.FixtureRequest) -> TrainedPolicies:
    return request.param


def commands(controller: Controller, references: Any, angles: Any) -> np.ndarray:
    def act(state: Any, now: Any) -> Any:
        angle, reference = now
        state, command = controller.act(state, Measured(angle, jnp.zeros(2)), reference)
        return state, jnp.stack(command)

    return np.asarray(
        jax.jit(lambda a, r: jax.lax.scan(act, controller.init(), (a, r)))(angles, references)[1]
    )


def test_controllers_meet_the_contract(run: TrainedPolicies) -> None:
    assert isinstance(controller_of(run), Controller)


def test_a_controller_acts_as_its_policy_does_in_the_task() -> None:
    task = ForceTracking(AnalyticFin(), GRID.task)
    controller = controller_of(GRID_RUN)
    act = jax.jit(lambda *now: controller.act(*now))
    step = jax.jit(task.step)
    for index, reference in enumerate(PAPER_REFERENCES[:3]):
        policy = jax.tree.map(lambda leaf, i=index: leaf[i], GRID_RUN.policies)
        at = References.of(Cell(low=reference, high=reference))
        fin = task.reset(jax.random.key(0), at)
        state = controller.init()
        memory = policy.init()
        for i in range(4):
            memory, action = policy.act(memory, task.observe(fin))
            state, command = act(state, Measured(fin.angle, jnp.zeros(2)), fin.reference)
            np.testing.assert_allclose(
                command, action_to_command(PAPER_LIMITS, action), rtol=1e-4, atol=1e-5
            )
            fin, _ = step(fin, action, PAPER_CLOCK.ticks[i % 3])


def test_each_reference_is_served_by_its_cell_and_the_nearest_beyond_the_grid() -> None:
    step = controller_of(GRID_RUN).step
    assert isinstance(step, GridStep)
    first = [int(step.nearest_cell(NUMPY, np.asarray(r, np.float32))) for r in PAPER_REFERENCES]
    assert first == [0, 1, 2, 3, 4, 5]
    assert int(step.nearest_cell(NUMPY, np.array([9.0, 0.0]))) == 3


def test_without_a_switch_the_memory_goes_on() -> None:
    controller = controller_of(GRID_RUN)
    reference = jnp.tile(jnp.array([2.0, 0.0]), (6, 1))
    cell = jax.tree.map(lambda leaf: leaf[2:3], GRID_RUN.policies)
    config = GRID_RUN.config.model_copy(update={"controller": "single"})
    alone = controller_of(
        GRID_RUN._replace(config=config, cells=GRID_RUN.cells[2:3], policies=cell)
    )
    angles = jnp.linspace(-0.5, 0.5, 6)
    np.testing.assert_allclose(
        commands(controller, reference, angles), commands(alone, reference, angles), rtol=1e-5
    )


def test_a_reference_outside_is_refused_with_the_nearest_cell() -> None:
    with pytest.raises(CoverageError, match=r"0\.71 N .* 6 cells \(x 1\.5 \.\. 2\.5, y 0\.5"):
        controller_of(GRID_RUN).check((3.0, 2.0))
    with pytest.raises(CoverageError, match=r"1\.5 N .* \(x 0\.5 \.\. 3\.5, y -1\.5 \.\. 1\.5"):
        controller_of(SINGLE_RUN).check((5.0, 0.0))


def test_every_reference_of_the_paper_is_covered(run: TrainedPolicies) -> None:
    for x, y in PAPER_REFERENCES:
        controller_of(run).check((float(x), float(y)))


def test_a_controller_comes_back_from_its_folder(run: TrainedPolicies, tmp_path: Path) -> None:
    save_policies(tmp_path / "c", run, {"seed": 5}, {})
    again = load_controller(tmp_path / "c")
    references = jnp.asarray([[1, -1], [2, 0], [2, 0], [2, 1]], jnp.float32)
    angles = jnp.linspace(-1, 1, 4)
    expected = commands(controller_of(run), references, angles)
    np.testing.assert_array_equal(commands(again, references, angles), expected)
    assert again.limits == PAPER_LIMITS
    with pytest.raises(CoverageError):
        again.check((9.0, 9.0))


def test_the_folder_describes_itself(run: TrainedPolicies, tmp_path: Path) -> None:
    save_policies(tmp_path / "c", run, {"seed": 5}, {})
    description = json.loads((tmp_path / "c" / "controller.json").read_text())
    assert description["kind"] == "controller"
    assert description["controller"] == run.config.controller
    assert description["provenance"] == {"seed": 5}
    assert len(description["scores"]) == len(run.cells) * run.config.lattice**2
    first = description["scores"][0]
    assert first["error_n"] == [0.25, 0.25]
    assert first["tracked_reference_n"] == pytest.approx(first["reference_n"])
    assert description["configuration"]["steps"] == run.config.steps
    assert (tmp_path / "c" / "training" / "learning.png").is_file()
