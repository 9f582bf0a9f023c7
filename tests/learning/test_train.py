"""Training runs: their policies, logs, and what stops them."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError, RunError
from softfin.gaits.reachable import PAPER_REFERENCES, Reachable, bounding_box
from softfin.learning import train as training
from softfin.learning.configuration import (
    GRID,
    SINGLE,
    TRAIN_PRESETS,
    TrainConfig,
    training_cells,
)
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.train import TrainedPolicies, train_policies
from softfin.stages.reproduce import PRESETS
from softfin.storage.run_directory import RunDirectory
from softfin.task.references import PAPER_CELLS, PAPER_RANGE
from softfin.task.task import TaskConfig
from tests.control.test_controllers import WIDE
from tests.full_disk import check_that_a_full_disk_stops, needs_full_device
from tests.plants import AnalyticFin, PlainFin
from tests.surrogate.streaming import small as streaming

SMALL = TrainConfig(
    controller="grid",
    range="paper",
    steps=4 * 24,
    task=TaskConfig(episode_actions=12, reference_actions=12),
    policy=PolicyConfig(units=8, width=8),
    ppo=PPOConfig(num_envs=4, num_steps=6, num_epochs=2, num_minibatches=2),
    num_evaluations=4,
    lattice=2,
)
NEAR_TWO = Reachable(np.array([1.5, -1], np.float32), np.full(32, 0.4, np.float32))
"""A fin that reaches the paper's first two cells only."""


@pytest.fixture
def work(tmp_path: Path) -> RunDirectory:
    return RunDirectory(tmp_path / "out", {})


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicies:
    work = RunDirectory(tmp_path_factory.mktemp("trained") / "out", {})
    return train_policies(AnalyticFin(), SMALL, NEAR_TWO, 5, work)


def test_there_is_a_policy_for_each_cell_and_none_are_alike(trained: TrainedPolicies) -> None:
    assert trained.cells == PAPER_CELLS[:2]
    kernels = np.asarray(trained.policies.net.lstm.kernel)
    assert len(np.unique(kernels.reshape(2, -1), axis=0)) == 2
    assert np.asarray(trained.evaluation.error).shape == (2, 4, 2)
    assert np.isfinite(trained.evaluation.error).all()


class Killed(Exception):
    """Ends a run after an update."""


def test_a_run_that_was_killed_resumes_to_the_same_policies_and_log(
    trained: TrainedPolicies, tmp_path: Path
) -> None:
    """It has two evaluations, and is killed in the update after the first."""
    config = SMALL.model_copy(update={"num_evaluations": 2})

    def kill(done: float, note: str) -> None:
        if done == 0.75:
            raise Killed

    whole = train_policies(
        AnalyticFin(), config, NEAR_TWO, 5, RunDirectory(tmp_path / "whole", {"seed": 5})
    )
    with pytest.raises(Killed):
        train_policies(
            AnalyticFin(), config, NEAR_TWO, 5, RunDirectory(tmp_path / "cut", {"seed": 5}), kill
        )
    resumed_from: list[float] = []
    resumed = train_policies(
        AnalyticFin(),
        config,
        NEAR_TWO,
        5,
        RunDirectory(tmp_path / "cut", {"seed": 5}, resume=True),
        lambda done, note: resumed_from.append(done),
    )
    assert resumed_from == [0.75, 1.0]
    jax.tree.map(np.testing.assert_array_equal, resumed.policies, whole.policies)
    jax.tree.map(np.testing.assert_array_equal, resumed.evaluation, whole.evaluation)
    assert resumed.log == whole.log
    assert [entry["step"] for entry in whole.log] == [24, 48, 72, 96]


def test_the_best_policies_of_a_killed_run_are_not_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Policies that are never better after it resumes; those of its first evaluation remain."""
    evaluate = training._evaluate
    seen: list[Any] = []

    def evaluate_worse_and_worse(
        task: TaskConfig, plant: Any, policies: Any, references: Any
    ) -> PolicyEvaluation:
        evaluation = evaluate(task, plant, policies, references)
        kernel = np.asarray(policies.net.lstm.kernel)
        if not any(np.array_equal(kernel, old) for old in seen):
            seen.append(kernel)
        age = next(i for i, old in enumerate(seen) if np.array_equal(kernel, old))
        return evaluation._replace(error=evaluation.error + age)

    monkeypatch.setattr(training, "_evaluate", evaluate_worse_and_worse)

    def kill(done: float, note: str) -> None:
        raise Killed

    with pytest.raises(Killed):
        train_policies(AnalyticFin(), SMALL, NEAR_TWO, 5, RunDirectory(tmp_path / "cut", {}), kill)
    resumed = train_policies(
        AnalyticFin(), SMALL, NEAR_TWO, 5, RunDirectory(tmp_path / "cut", {}, resume=True)
    )
    assert len(seen) == 4
    np.testing.assert_array_equal(resumed.policies.net.lstm.kernel, seen[0])


@needs_full_device
def test_a_full_disk_stops_the_training_with_an_error(work: RunDirectory) -> None:
    check_that_a_full_disk_stops(
        lambda: train_policies(AnalyticFin(), SMALL, NEAR_TWO, 5, work), work.folder
    )


def test_policies_depend_on_their_seed_and_cell_only(
    trained: TrainedPolicies, tmp_path: Path
) -> None:
    first = Reachable(np.array([1, -1], np.float32), np.full(32, 0.4, np.float32))
    again = train_policies(AnalyticFin(), SMALL, NEAR_TWO, 5, RunDirectory(tmp_path / "again", {}))
    jax.tree.map(np.testing.assert_array_equal, again.policies, trained.policies)
    other = train_policies(AnalyticFin(), SMALL, NEAR_TWO, 6, RunDirectory(tmp_path / "other", {}))
    kernels = [np.asarray(run.policies.net.lstm.kernel[0]) for run in (trained, other)]
    assert (kernels[0] != kernels[1]).any()
    assert training_cells(SMALL, first) == PAPER_CELLS[:1]


def test_the_log_has_every_update_and_the_score_without_noise(trained: TrainedPolicies) -> None:
    assert [entry["step"] for entry in trained.log] == [24, 48, 72, 96]
    for entry in trained.log:
        assert {"reward", "kl", "error_x_n", "score_x_n", "score_y_n"} <= set(entry)


def test_the_policies_with_the_lowest_errors_are_kept(trained: TrainedPolicies) -> None:
    best = np.asarray(trained.evaluation.error).mean()
    logged = [(entry["score_x_n"] + entry["score_y_n"]) / 2 for entry in trained.log]
    assert best <= min(logged) + 1e-6


@pytest.mark.parametrize(("updates", "count"), [(10, 3), (4, 10), (7, 1)])
def test_evaluations_are_spread_over_the_run_and_the_last_update_is_one(
    updates: int, count: int
) -> None:
    steps = updates * SMALL.ppo.steps_per_update
    config = SMALL.model_copy(update={"steps": steps, "num_evaluations": count})
    due = [update for update in range(1, updates + 1) if training._is_evaluated(config, update)]
    assert len(due) == min(count, updates)
    assert due[-1] == updates


def test_a_loss_that_is_not_finite_stops_with_its_place(work: RunDirectory) -> None:
    with pytest.raises(RunError, match=r"loss .* update 1, cell x 0\.5 .* ppo\.learning_rate"):
        train_policies(AnalyticFin(gain=np.nan), SMALL, NEAR_TWO, 0, work)


def test_forces_that_are_not_finite_stop_it_as_a_loss_does(
    monkeypatch: pytest.MonkeyPatch, work: RunDirectory
) -> None:
    """Else a run of hours would end with policies that were never any good."""
    worst = PolicyEvaluation(jnp.array([[[0.5, 0.5]], [[jnp.nan, 0.5]]]), jnp.zeros((2, 1, 2)))
    monkeypatch.setattr(training, "_evaluate", lambda *given, references: worst)
    with pytest.raises(RunError, match=r"force in the evaluation .* update 1, cell x 1\.5"):
        train_policies(AnalyticFin(), SMALL, NEAR_TWO, 0, work)


def test_a_budget_under_one_rollout_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"steps = 23: .* 24"):
        SMALL.changed(["steps=23"])


def test_a_rollout_that_ends_within_a_cycle_of_the_clock_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"ppo.num_steps = 7: must be a multiple of 3"):
        SMALL.changed(["ppo.num_steps=7"])


def test_a_reproduction_has_the_budgets_and_references_of_the_paper() -> None:
    paper = [
        configure(TRAIN_PRESETS[kind], changes)
        for kind, changes in PRESETS["paper"].policies.items()
    ]
    assert [config.controller for config in paper] == ["single", "grid"]
    assert [config.steps for config in paper] == [30_000, 10_000]
    assert {config.range for config in paper} == {"paper"}
    for config in (SINGLE, GRID):
        assert config.task.episode_actions / 3 == 30


def test_the_paper_range_has_its_references_and_cells() -> None:
    assert training_cells(SINGLE.changed(["range=paper"]), WIDE) == (PAPER_RANGE,)
    cells = training_cells(GRID.changed(["range=paper"]), WIDE)
    assert cells == PAPER_CELLS
    for cell, reference in zip(cells, PAPER_REFERENCES, strict=True):
        assert cell.distance(reference) == 0


def test_six_cells_cover_the_reach() -> None:
    assert training_cells(SINGLE, WIDE) == (WIDE.bounding_box(),)
    cells = training_cells(GRID, WIDE)
    assert len(cells) == 6
    assert bounding_box(cells) == WIDE.bounding_box()


def test_a_grid_has_no_cell_that_the_fin_cannot_reach() -> None:
    diagonal = np.full(8, 0.3, np.float32)
    diagonal[[1, 5]] = 2
    region = Reachable(np.zeros(2, np.float32), diagonal)
    cells = training_cells(GRID, region)
    assert 2 <= len(cells) < 6
    for cell in cells:
        assert region.contains(cell.lattice(8)).any()


def test_a_fin_that_cannot_produce_the_papers_references_is_refused_with_its_reach() -> None:
    small = Reachable(np.zeros(2, np.float32), np.full(32, 0.1, np.float32))
    with pytest.raises(ConfigurationError) as refused:
        training_cells(SINGLE.changed(["range=paper"]), small)
    assert str(refused.value).startswith("range paper: ")
    assert "x -0.1 .. 0.1, y -0.1 .. 0.1 N" in str(refused.value)


def test_the_log_says_how_often_policies_leave_the_data_of_a_surrogate_that_knows(
    trained: TrainedPolicies, monkeypatch: pytest.MonkeyPatch, work: RunDirectory
) -> None:
    """It is the evaluation that says so: here nothing is learnt, as learning in a surrogate takes
    long to compile."""
    idle = dict.fromkeys(("loss", "gradient_norm", "error_x_n", "error_y_n"), jnp.zeros(1))
    monkeypatch.setattr(training, "_update", lambda config, plant, agents: (agents, idle))
    one = SMALL.model_copy(update={"controller": "single", "num_evaluations": 1})
    run = train_policies(streaming.surrogate(), one, WIDE, 0, work)
    assert 0 <= run.log[-1]["score_out_of_distribution"] <= 1
    assert not any("score_out_of_distribution" in entry for entry in trained.log)


def test_policies_are_evaluated_in_their_own_plant_of_several_of_one_class(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    idle = dict.fromkeys(("loss", "gradient_norm", "error_x_n", "error_y_n"), jnp.zeros(2))
    monkeypatch.setattr(training, "_update", lambda config, plant, agents: (agents, idle))

    def error(plant: PlainFin) -> Any:
        work = RunDirectory(tmp_path / "out", {}, overwrite=True)
        return np.asarray(train_policies(plant, SMALL, NEAR_TWO, 0, work).evaluation.error)

    weak = error(PlainFin(gain=0.1))
    assert (error(PlainFin(gain=2.0)) != weak).any()
    np.testing.assert_array_equal(weak, error(PlainFin(gain=0.1)))


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_the_progress_shows_errors_with_decimals_for_the_size_of_the_fin(
    scale: float, monkeypatch: pytest.MonkeyPatch, work: RunDirectory
) -> None:
    metrics = {"error_x_n": [0.12 * scale] * 2, "error_y_n": [0.35 * scale] * 2}
    idle = {name: jnp.zeros(2) for name in ("loss", "gradient_norm")} | metrics
    monkeypatch.setattr(training, "_update", lambda config, plant, agents: (agents, idle))
    said: list[tuple[float, str]] = []
    train_policies(
        AnalyticFin(), SMALL, NEAR_TWO, 0, work, lambda done, note: said.append((done, note))
    )
    assert [done for done, _ in said] == [0.25, 0.5, 0.75, 1.0]
    errors = {1.0: "0.12/0.35", 0.05: "0.006/0.017"}[scale]
    assert said[-1][1] == f"error {errors} N while exploring"
