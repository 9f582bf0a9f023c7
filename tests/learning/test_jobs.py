"""A training run in jobs: names, order, restarts, what comes home from other machines."""

from pathlib import Path

import jax
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.gaits.force_map import MapConfig, empty_map
from softfin.gaits.reachable import Reachable
from softfin.learning import train as train_module
from softfin.learning.configuration import TrainConfig
from softfin.learning.engine import Engine
from softfin.learning.run import TrainingResult
from softfin.learning.train import default_split, split_run, train, train_jobs
from softfin.storage.run_directory import CHECKPOINT, read_log
from softfin.task.references import PAPER_RANGE
from tests.learning.ray_cluster import SEEDS, SMALL, alike, run_directory
from tests.plants import AnalyticFin

ONE_CELL = SMALL.model_copy(update={"cells": SMALL.cells[:1]})
"""Two seeds of it are as many lanes as the two cells of `SMALL` with one seed: one compiled program does both."""


def in_one(config: TrainConfig, seeds: tuple[int, ...], folder: Path) -> TrainingResult:
    """Trained in this process, as no job of a run."""
    best = train(AnalyticFin(), config, seeds, run_directory(folder, seeds=seeds), None, None)
    return TrainingResult(config, AnalyticFin().limits, seeds, *best)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    """Both cells, of the first seed."""
    return in_one(SMALL, (0,), tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def by_cell(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    return train_jobs(AnalyticFin(), SMALL, SEEDS, run_directory(tmp_path_factory.mktemp("cells")), split="cell")


def test_jobs_are_named_after_their_seeds_and_cells():
    assert list(split_run(SMALL, (4, 7), "none")) == ["all"]
    assert list(split_run(SMALL, (4, 7), "seed")) == ["seed-4", "seed-7"]
    cells = split_run(SMALL, (4, 7), "cell")
    assert list(cells) == ["seed-4-cell-0", "seed-4-cell-1", "seed-7-cell-0", "seed-7-cell-1"]
    assert cells["seed-7-cell-1"] == (slice(1, 2), slice(1, 2))


@pytest.mark.parametrize(
    ("engine", "seeds", "split"), [("local", (0, 1), "none"), ("ray", (0, 1), "seed"), ("ray", (0,), "cell")]
)
def test_the_usual_split_is_one_program_here_and_seeds_or_cells_elsewhere(engine, seeds, split):
    assert default_split(engine, seeds) == split


def test_one_job_is_the_run_itself(whole: TrainingResult, tmp_path: Path):
    space = run_directory(tmp_path, seeds=(0,))
    alike(train_jobs(AnalyticFin(), SMALL, (0,), space), whole)
    assert (space.folder / CHECKPOINT).is_file()


def test_jobs_of_single_cells_learn_what_the_whole_learns_but_for_rounding(
    whole: TrainingResult, by_cell: TrainingResult
):
    assert by_cell.seeds == SEEDS
    assert by_cell.config == whole.config
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[:1], b, atol=1e-3), by_cell.policies, whole.policies)
    kernels = np.asarray(by_cell.policies.net.lstm.kernel).reshape(4, -1)
    apart = np.abs(kernels[:, None] - kernels[None]).max(axis=-1)[~np.eye(4, dtype=bool)]
    assert apart.min() > 0.1


def test_jobs_of_seeds_learn_what_the_whole_learns_but_for_rounding(tmp_path: Path):
    whole = in_one(ONE_CELL, SEEDS, tmp_path / "whole")
    by_seed = train_jobs(AnalyticFin(), ONE_CELL, SEEDS, run_directory(tmp_path / "seeds"), split="seed")
    assert by_seed.seeds == whole.seeds
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), by_seed.policies, whole.policies)


class Cut(Exception):
    """The power goes."""


def test_a_run_stopped_in_its_second_job_goes_on_there_and_ends_the_same(by_cell: TrainingResult, tmp_path: Path):
    notes = []

    def cut(stage: str, done: float, note: str) -> None:
        if done > 0.25 + 0.6 / 4:
            raise Cut

    with pytest.raises(Cut):
        train_jobs(AnalyticFin(), SMALL, SEEDS, run_directory(tmp_path), cut, split="cell")
    resumed = train_jobs(
        AnalyticFin(),
        SMALL,
        SEEDS,
        run_directory(tmp_path, resume=True),
        lambda *said: notes.append(said),
        split="cell",
    )
    alike(resumed, by_cell)
    assert not any(note.startswith("seed-0-cell-0") for _, _, note in notes)
    again = [done for _, done, note in notes if note.startswith("seed-0-cell-1")]
    assert 0 < len(again) < SMALL.num_updates
    assert notes[-1][:2] == ("train grid", 1.0)


class Distant(Engine):
    """Machines that do not see the driver's disk."""

    def map(self, stage, work, parts, progress):
        return super().map(stage, work, {name: part._replace(token="another") for name, part in parts.items()}, None)


def test_what_was_learnt_on_a_disk_of_its_own_comes_home_with_its_log_and_checkpoint(
    by_cell: TrainingResult, tmp_path: Path
):
    space = run_directory(tmp_path)
    alike(train_jobs(AnalyticFin(), SMALL, SEEDS, space, engine=Distant(), split="cell"), by_cell)
    for name in split_run(SMALL, SEEDS, "cell"):
        assert (space.folder / name / CHECKPOINT).is_file()
        assert [entry["step"] for entry in read_log(space.folder / name / "log.jsonl")] == [24, 48, 72, 96]
    space.keep_log(tmp_path / "kept")
    assert len(list((tmp_path / "kept").rglob("events.*"))) == 4


def test_seeds_that_repeat_are_refused_before_they_are_parted(tmp_path: Path):
    with pytest.raises(ConfigurationError, match=r"seeds \[3, 3\]: give at least one, and each once"):
        train_jobs(AnalyticFin(), SMALL, (3, 3), run_directory(tmp_path, seeds=(3, 3)), split="seed")


def test_the_fin_is_mapped_once_over_all_cells_for_all_jobs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    asked, given = [], []
    found = empty_map(MapConfig(box=PAPER_RANGE).empty_table(Reachable(np.zeros(2), np.ones(8))), 8)

    def remembered(*arguments):
        given.append(arguments[5])
        return train(*arguments[:5], None)

    monkeypatch.setattr(train_module, "find_map", lambda plant, config, *_: asked.append(config.cells) or found)
    monkeypatch.setattr(train_module, "train", remembered)
    trained = train_jobs(AnalyticFin(), SMALL, (0,), run_directory(tmp_path), split="cell")
    assert asked == [SMALL.cells]
    assert len(given) == 2
    assert all(force_map is found for force_map in (*given, trained.force_map))
