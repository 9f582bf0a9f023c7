"""A training run as jobs that are independent of each other: a part of its seeds and cells each, on any engine.

A job is a run of its own with its own checkpoints. Its result depends on its seeds and cells alone, so with the same
split all engines give the same bits. Another split gives agents of the same keys in programs of another width, which
round differently.
"""

import copy
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
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
from softfin.learning.policy import Policy
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.run import TrainingResult
from softfin.learning.train import find_map, pretrain_shared_policy, train
from softfin.storage.artifact import write_file
from softfin.storage.run_directory import RunDirectory

TOKEN = "here"
"""File by which a worker recognises the driver's folder, and not one of the same name."""

Work: TypeAlias = Callable[[Any, Progress | None], Any]
"""Work on one part, which reports its progress where it can; it gives the same result wherever it runs."""


class Engine:
    """Works on one part after the other in this process; other engines override `map`."""

    def map(self, stage: str, work: Work, parts: Mapping[str, Any], progress: Progress | None) -> list[Any]:
        """The result of every part, in their order; `stage` names the whole in the progress.

        Here an error of a part ends the run, and the parts after it are not begun.
        """

        def report(index: int, name: str, _: str, fraction: float, note: str) -> None:
            if progress is not None:
                progress(stage, (index + fraction) / len(parts), note if len(parts) == 1 else f"{name}: {note}")

        return [work(item, partial(report, i, name)) for i, (name, item) in enumerate(parts.items())]


def find_engine(name: EngineName, cluster: str | None = None) -> Engine:
    """The engine of that name; raises ConfigurationError where Ray is not installed, or the cluster cannot be used."""
    if name == "ray":
        # Ray is an extra, and takes a second to import.
        from softfin.learning.engine_ray import RayEngine

        return RayEngine(cluster)
    if cluster is not None:
        raise ConfigurationError(f"cluster {cluster}: the local engine has none; give --engine ray, or no --cluster")
    return Engine()


def default_split(engine: EngineName, seeds: Sequence[int]) -> Split:
    """One program is fastest on one machine; on many, all of a seed goes to one as long as there are several seeds."""
    if engine == "local":
        return "none"
    return "seed" if len(seeds) > 1 else "cell"


class Job(NamedTuple):
    """A part of a run, and where its unfinished work lies."""

    config: TrainConfig
    """Configuration of the whole run, without the cells of other jobs."""
    seeds: tuple[int, ...]
    run_directory: RunDirectory
    token: str
    start: Policy | None
    """Policies that the job begins from."""


def split_run(config: TrainConfig, seeds: Sequence[int], split: Split) -> dict[str, tuple[slice, slice]]:
    """Seeds and cells of each job by its name, seeds before cells."""
    if split == "none":
        return {"all": (slice(None), slice(None))}
    if split == "seed":
        return {f"seed-{seed}": (slice(i, i + 1), slice(None)) for i, seed in enumerate(seeds)}
    return {
        f"seed-{seed}-cell-{j}": (slice(i, i + 1), slice(j, j + 1))
        for i, seed in enumerate(seeds)
        for j in range(len(config.cells))
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
    """Train a policy for every seed and cell, in jobs on an engine; goes on from their checkpoints where there are any.

    Without a `force_map` the fin is mapped, where a map is needed, once for all jobs.

    Raises:
        ConfigurationError: the budget is smaller than one rollout, a seed comes twice, or the plant or its map does
            not fit the configuration.
        RunError: a job failed; the last good checkpoints of all are left in the run_directory.
    """
    check(plant, config, seeds, force_map)
    force_map = find_map(plant, config, run_directory, progress) if force_map is None else force_map
    start = pretrain_shared_policy(plant, config, seeds, run_directory, progress, force_map)
    token, jobs = uuid4().hex, {}
    for name, at in split_run(config, seeds, split).items():
        part = run_directory if split == "none" else run_directory.part(name)
        write_file(part.folder / TOKEN, token)
        own = config.model_copy(update={"cells": config.cells[at[1]]})
        jobs[name] = Job(own, tuple(seeds)[at[0]], part, token, jax.tree.map(lambda leaf, at=at: leaf[at], start))
    work = partial(_train_job, plant, force_map)
    done = (engine or Engine()).map(f"train {config.controller}", work, jobs, progress)
    for job, (_, files) in zip(jobs.values(), done, strict=True):
        for file, data in files.items():
            write_file(job.run_directory.folder / file, data)
    policies, evaluation = jax.tree.map(
        lambda *x: np.concatenate(x).reshape(len(seeds), -1, *x[0].shape[2:]), *(result for result, _ in done)
    )
    return TrainingResult(config, Limits(*map(float, plant.limits)), tuple(seeds), policies, evaluation, force_map)


def _train_job(
    plant: Plant, force_map: ForceMap | None, job: Job, progress: Progress | None
) -> tuple[tuple[Policy, PolicyEvaluation], dict[str, bytes]]:
    """Train, from the last checkpoint where the driver's folder is the same here.

    Elsewhere the work is done in a folder of this machine's own, whose files are sent back with the result.
    """

    def trained(run_directory: RunDirectory) -> tuple[Policy, PolicyEvaluation]:
        result = train(plant, job.config, job.seeds, run_directory, progress, force_map, job.start)
        return result.policies, result.evaluation

    file = job.run_directory.folder / TOKEN
    if file.is_file() and file.read_text() == job.token:
        return trained(job.run_directory), {}
    own = copy.copy(job.run_directory)
    with tempfile.TemporaryDirectory(prefix="softfin-", ignore_cleanup_errors=True) as name:
        own.folder = folder = Path(name)
        result = trained(own)
        files = (path for path in folder.rglob("*") if path.is_file())
        return result, {str(path.relative_to(folder)): path.read_bytes() for path in files}
