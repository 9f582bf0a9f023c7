"""A training run as jobs that are independent of each other: a part of its seeds and cells each, on any engine.

A job is a run of its own with its own checkpoints. Its result depends on its seeds and cells alone, so with the same
split all engines give the same bits. Another split gives agents of the same keys in programs of another width, which
round differently.
"""

import copy
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import jax
import numpy as np

from softfin.core.choices import EngineName, Split
from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap
from softfin.learning.configuration import TrainConfig, check
from softfin.learning.engine import Engine, LocalEngine
from softfin.learning.policy import Policy
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import TrainingResult
from softfin.learning.train import find_map, pretrain_shared_policy, train
from softfin.storage.artifact import write_file
from softfin.storage.run_directory import RunDirectory

TOKEN = "here"
"""File by which a worker recognises the driver's folder, and not one of the same name."""


class Job(NamedTuple):
    """A part of a run."""

    config: TrainConfig
    """Configuration of the whole run, without the cells of other jobs."""
    seeds: tuple[int, ...]


class JobResult(NamedTuple):
    """What a job sends back."""

    policies: Policy
    """As in `TrainingResult`, of the job's agents."""
    evaluation: PolicyEvaluation
    files: Mapping[str, bytes]
    """Checkpoint and logs, from a worker without access to the driver's folder."""


def find_engine(name: EngineName, cluster: str | None = None) -> Engine:
    """The engine of that name; raises ConfigurationError where Ray is not installed, or the cluster cannot be used."""
    if name == "local":
        if cluster is not None:
            raise ConfigurationError(
                f"cluster {cluster}: the local engine has none; give --engine ray, or no --cluster"
            )
        return LocalEngine()
    # Ray is an extra, and takes a second to import.
    from softfin.learning.engine_ray import RayEngine

    return RayEngine(cluster)


def default_split(engine: EngineName, seeds: Sequence[int]) -> Split:
    """One program is fastest on one machine; on many, all of a seed goes to one as long as there are several seeds."""
    if engine == "local":
        return "none"
    return "seed" if len(seeds) > 1 else "cell"


def jobs_of(config: TrainConfig, seeds: Sequence[int], split: Split) -> dict[str, Job]:
    """The jobs by name, seeds before cells."""
    if split == "none":
        return {"all": Job(config, tuple(seeds))}
    if split == "seed":
        return {f"seed-{seed}": Job(config, (seed,)) for seed in seeds}
    return {
        f"seed-{seed}-cell-{i}": Job(config.model_copy(update={"cells": (cell,)}), (seed,))
        for seed in seeds
        for i, cell in enumerate(config.cells)
    }


def train_jobs(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None = None,
    *,
    engine: Engine | None = None,
    split: Split = "none",
    force_map: ForceMap | None = None,
) -> TrainingResult:
    """Train as `train` does, in jobs on an engine; without a `force_map` the fin is mapped once for all of them.

    Raises:
        ConfigurationError: as `train`.
        RunError: a job failed; the last good checkpoints of all are left in the run_directory.
    """
    check(plant, config, seeds, force_map)
    force_map = find_map(plant, config, run_directory, progress) if force_map is None else force_map
    start = pretrain_shared_policy(plant, config, seeds, run_directory, progress, force_map)
    jobs, token = jobs_of(config, seeds, split), uuid4().hex
    rows = 1 if split == "none" else len(seeds)
    placed = {}
    for index, (name, job) in enumerate(jobs.items()):
        folder = run_directory if split == "none" else run_directory.part(name)
        write_file(folder.folder / TOKEN, token)
        placed[name] = _PlacedJob(job, folder, token, _part(start, *divmod(index, len(jobs) // rows), split))
    done = (engine or LocalEngine()).map(f"train {config.controller}", _Training(plant, force_map), placed, progress)
    for place, result in zip(placed.values(), done, strict=True):
        for file, data in result.files.items():
            write_file(place.run_directory.folder / file, data)
    policies, evaluation = _together([(part.policies, part.evaluation) for part in done], rows)
    return TrainingResult(config, Limits(*map(float, plant.limits)), tuple(seeds), policies, evaluation, force_map)


def _part(start: Policy | None, seed: int, cell: int, split: Split) -> Policy | None:
    """What one job begins from, of policies with leaves ``(seeds, cells, ...)``."""
    if start is None or split == "none":
        return start
    cells = slice(None) if split == "seed" else slice(cell, cell + 1)
    chosen: Policy = jax.tree.map(lambda leaf: leaf[seed : seed + 1, cells], start)
    return chosen


def _together(parts: Sequence[Any], rows: int) -> Any:
    """Trees of leaves ``(seeds, cells, ...)``, put together by `rows` of seeds."""
    cells = len(parts) // rows
    across = [jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts[i * cells : (i + 1) * cells])
              for i in range(rows)]  # fmt: skip
    return jax.tree.map(lambda *x: np.concatenate(x, axis=0), *across)


class _PlacedJob(NamedTuple):
    """A job, and where its unfinished work lies."""

    job: Job
    run_directory: RunDirectory
    token: str
    start: Policy | None


@dataclass(frozen=True)
class _Training:
    """The work on a job; the plant travels as arrays and the name of its class."""

    plant: Plant
    force_map: ForceMap | None

    def __call__(self, placed: _PlacedJob, progress: Progress | None) -> JobResult:
        """Train, from the last checkpoint where the driver's folder is the same here.

        Elsewhere the work is done in a folder of this machine's own, whose files are sent back with the result.
        """
        try:
            is_here = (placed.run_directory.folder / TOKEN).read_text() == placed.token
        except OSError:
            is_here = False
        if is_here:
            return self._train(placed, placed.run_directory, progress)
        folder = Path(tempfile.mkdtemp(prefix="softfin-"))
        own = copy.copy(placed.run_directory)
        own.folder = folder
        try:
            result = self._train(placed, own, progress)
            files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
            return result._replace(files=files)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _train(self, placed: _PlacedJob, run_directory: RunDirectory, progress: Progress | None) -> JobResult:
        config, seeds = placed.job
        result = train(self.plant, config, seeds, run_directory, progress, force_map=self.force_map, start=placed.start)
        return JobResult(result.policies, result.evaluation, {})
