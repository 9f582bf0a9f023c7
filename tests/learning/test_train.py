"""Training runs: lanes, checkpoints, resuming, logs, what stops them."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors

from softfin.core.errors import ConfigurationError, RunError
from softfin.gaits.reachable import Cell
from softfin.learning import run as run_module
from softfin.learning.configuration import GRID, SINGLE, TrainConfig
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import RunState, TrainingResult, TrainingRun
from softfin.learning.train import train
from softfin.storage.run_directory import CHECKPOINT, RunDirectory, read_training_log
from softfin.task.task import TaskConfig
from tests.full_disk import check_that_a_full_disk_stops, needs_full_device
from tests.plants import AnalyticFin, PlainFin
from tests.surrogate.streaming import small as streaming

SMALL = TrainConfig(
    steps=4 * 24,
    cells=(Cell.around((1, -1)), Cell.around((2, 0))),
    task=TaskConfig(episode_actions=12, reference_actions=12),
    policy=PolicyConfig(units=8, width=8),
    ppo=PPOConfig(num_envs=4, num_steps=6, num_epochs=2, num_minibatches=2),
    num_evaluations=4,
)


class Cut(Exception):
    """The power goes."""


def trained(
    folder: Path, seeds: tuple[int, ...] = (0,), config: TrainConfig = SMALL, **options: Any
) -> TrainingResult:
    metadata = {"configuration": config.model_dump(mode="json"), "seeds": list(seeds)}
    run_directory = RunDirectory(folder / "out", metadata, resume=options.pop("resume", False))
    return train(options.pop("plant", AnalyticFin()), config, seeds, run_directory, **options)


def log_of(folder: Path) -> list[dict[str, Any]]:
    return read_training_log(folder / ".out.unfinished" / "log.jsonl")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainingResult, Path]:
    folder = tmp_path_factory.mktemp("whole")
    return trained(folder, (0, 1)), folder


def test_there_is_a_policy_for_each_seed_and_cell_and_none_are_alike(
    whole: tuple[TrainingResult, Path],
) -> None:
    kernels = np.asarray(whole[0].policies.net.lstm.kernel)
    assert kernels.shape[:2] == (2, 2)
    assert len(np.unique(kernels.reshape(4, -1), axis=0)) == 4
    assert np.asarray(whole[0].evaluation.error).shape == (2, 2, 4, 2)
    assert np.isfinite(whole[0].evaluation.error).all()


def test_a_resumed_run_ends_as_one_that_was_never_stopped(
    whole: tuple[TrainingResult, Path], tmp_path: Path
) -> None:
    def cut(stage: str, done: float, note: str) -> None:
        if done >= 0.6:
            raise Cut

    with pytest.raises(Cut):
        trained(tmp_path, (0, 1), progress=cut)
    resumed = trained(tmp_path, (0, 1), resume=True)

    jax.tree.map(np.testing.assert_array_equal, resumed.policies, whole[0].policies)
    jax.tree.map(np.testing.assert_array_equal, resumed.evaluation, whole[0].evaluation)
    assert log_of(tmp_path) == log_of(whole[1])


def test_a_lane_learns_the_same_whatever_lanes_are_beside_it(
    whole: tuple[TrainingResult, Path], tmp_path: Path
) -> None:
    """Alone, too: test_devices.py compares that."""
    other = trained(tmp_path, (1, 7), SMALL.model_copy(update={"cells": SMALL.cells[::-1]}))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[0, 0], b[1, 1], atol=1e-3),
        other.policies,
        whole[0].policies,
    )


def test_the_log_tells_every_update_and_seed_and_the_deterministic_score(
    whole: tuple[TrainingResult, Path],
) -> None:
    entries = log_of(whole[1])
    assert [entry["step"] for entry in entries] == [24, 48, 72, 96]
    for entry in entries:
        assert {
            f"seed{s}/{n}" for s in (0, 1) for n in ("reward", "kl", "score_x_n", "score_y_n")
        } <= set(entry)
    assert list((whole[1] / ".out.unfinished").glob("events.*"))


def test_the_policy_with_the_best_deterministic_score_is_kept(
    whole: tuple[TrainingResult, Path],
) -> None:
    entries = log_of(whole[1])
    for i, seed in enumerate((0, 1)):
        best = np.asarray(whole[0].evaluation.error)[i].mean()
        logged = [
            entry[f"seed{seed}/score_x_n"] + entry[f"seed{seed}/score_y_n"] for entry in entries
        ]
        assert best <= min(logged) / 2 + 1e-6


def test_a_loss_that_is_not_finite_stops_with_its_place_and_the_last_good_checkpoint(
    tmp_path: Path,
) -> None:
    """After one good update the plant has no forces any more."""

    def cut(stage: str, done: float, note: str) -> None:
        raise Cut

    with pytest.raises(Cut):
        trained(tmp_path, (5, 6), progress=cut)
    words = (
        r"the loss is NaN or infinite in update 2 of 4, seed 5, cell x 0.5 .. 1.5, y -1.5 .. -0.5 "
        r"N; lower ppo.learning"
    )
    with pytest.raises(RunError, match=words):
        trained(tmp_path, (5, 6), plant=AnalyticFin(gain=np.nan), resume=True)
    with safetensors.safe_open(tmp_path / ".out.unfinished" / CHECKPOINT, "numpy") as file:
        assert json.loads(file.metadata()["facts"])["updates"] == 1


def test_scores_that_are_not_finite_stop_it_as_a_loss_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a run of hours would end with policies that were never any good."""
    run = object.__new__(TrainingRun)
    run.config = SMALL
    run.agents = [(5, cell) for cell in SMALL.cells]
    worst = PolicyEvaluation(jnp.array([[[0.5, 0.5]], [[jnp.nan, 0.5]]]), jnp.zeros((2, 1, 2)))
    monkeypatch.setattr(run_module, "_evaluate", lambda *given: worst)
    run.plant = None
    run.references = jnp.zeros((2, 1, 2))
    words = (
        r"^train: the force in the evaluation is NaN or infinite in update 3 of 4, "
        r"seed 5, cell x 1.5 .. 2.5"
    )
    with pytest.raises(RunError, match=words):
        run.evaluate(jax.eval_shape(lambda: Policy.create(jax.random.key(0), SMALL.policy, 11)), 3)


def test_a_budget_under_one_rollout_and_repeated_seeds_are_refused(tmp_path: Path) -> None:
    small = SMALL.model_copy(update={"steps": 23})
    with pytest.raises(
        ConfigurationError, match=r"steps = 23: fewer than one rollout of 24 \(4 environments x 6"
    ):
        trained(tmp_path, config=small)
    with pytest.raises(
        ConfigurationError, match=r"seeds \[3, 3\]: use at least one seed, without duplicates"
    ):
        trained(tmp_path, (3, 3))


def test_a_single_controller_of_two_cells_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="a single controller must have one cell, not 2"):
        TrainConfig.build({**SMALL.model_dump(), "controller": "single"})


def test_the_budgets_are_those_of_the_paper() -> None:
    assert (SINGLE.steps, len(SINGLE.cells)) == (30_000, 1)
    assert (GRID.steps, len(GRID.cells)) == (10_000, 6)
    for config in (SINGLE, GRID):
        assert (
            config.steps - config.ppo.steps_per_update
            < config.num_updates * config.ppo.steps_per_update
            <= config.steps
        )
        assert config.task.episode_actions / 3 == 30


def test_the_log_says_how_often_policies_leave_the_data_of_a_surrogate_that_knows(
    whole: tuple[TrainingResult, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the scoring that says so: here nothing is learnt, as learning in a surrogate takes long
    to compile."""
    idle = dict.fromkeys(("loss", "gradient_norm", "error_x_n", "error_y_n"), jnp.zeros(1))
    monkeypatch.setattr(run_module, "_update", lambda program, plant, lanes: (lanes, idle))
    one = SMALL.model_copy(update={"cells": SMALL.cells[:1], "num_evaluations": 1})
    trained(tmp_path, config=one, plant=streaming.surrogate())
    (entry,) = [entry for entry in log_of(tmp_path) if "seed0/score_x_n" in entry]
    assert 0 <= entry["seed0/score_out_of_distribution"] <= 1
    assert not any("seed0/score_out_of_distribution" in entry for entry in log_of(whole[1]))


def test_policies_are_scored_in_the_plant_as_it_is_now(whole: tuple[TrainingResult, Path]) -> None:
    policies = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), whole[0].policies)

    def error(plant: PlainFin) -> Any:
        return np.asarray(TrainingRun(plant, SMALL, (0, 1), None).evaluate(policies, 0).error)

    plant = PlainFin(gain=0.1)
    before = error(plant)
    plant._fin = AnalyticFin(gain=2.0)
    after = error(plant)
    assert (after != before).any()
    np.testing.assert_array_equal(after, error(PlainFin(gain=2.0)))
    np.testing.assert_array_equal(before, error(PlainFin(gain=0.1)))


def test_policies_are_scored_without_the_noise_of_the_sensed_angle(
    whole: tuple[TrainingResult, Path],
) -> None:
    policies = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), whole[0].policies)
    noisy = SMALL.changed(["task.sensing.noise_rad=0.5"])
    evaluation = TrainingRun(AnalyticFin(), noisy, (0, 1), None).evaluate(policies, 0)
    expected = TrainingRun(AnalyticFin(), SMALL, (0, 1), None).evaluate(policies, 0)
    np.testing.assert_array_equal(evaluation.error, expected.error)


def test_an_episode_without_a_whole_window_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r"episode_actions = 3: an episode of 100 samples .* window of 200"
    ):
        trained(tmp_path, config=SMALL.changed(["task.episode_actions=3"]))


@pytest.mark.parametrize(
    ("scale", "expected"),
    [
        (1.0, "error 0.12/0.35 N, best deterministic 0.12/0.35 N"),
        (0.05, "error 0.006/0.017 N, best deterministic 0.006/0.017 N"),
    ],
)
def test_the_progress_shows_errors_with_decimals_for_the_size_of_the_fin(scale, expected):
    run = TrainingRun(AnalyticFin(), TrainConfig(cells=(Cell.around((2, 0)),)), (0,), None)
    run.references = scale * run.references
    error = np.full((1, 4, 2), scale * np.array([0.12, 0.35]))
    metrics = {"error_x_n": np.array([scale * 0.12]), "error_y_n": np.array([scale * 0.35])}
    state = RunState(None, None, PolicyEvaluation(error, error, None))
    assert run.note(metrics, state) == expected


@needs_full_device
def test_a_full_disk_stops_the_training_with_an_error(tmp_path: Path) -> None:
    check_that_a_full_disk_stops(
        lambda: trained(tmp_path, (0, 1)), work=tmp_path / ".out.unfinished"
    )
