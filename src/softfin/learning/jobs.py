"""A training run as jobs that need not know of each other: a part of its seeds and cells each, on any engine.

A job is a run of its own with its own checkpoints. What it ends with depends on its seeds and cells alone, so with the
same split all engines give the same bits. Another split gives lanes of the same keys in programs of another width,
which round differently.
"""

import copy
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import jax
import numpy as np

from softfin.core.choices import EngineName, Split
from softfin.core.plant import Plant
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap
from softfin.learning.engine import Engine, LocalEngine, Progress
from softfin.learning.policy import Policy
from softfin.learning.score import Score
from softfin.learning.train import TrainConfig, Trained, check, common_start, mapped, train
from softfin.storage.artifact import write_file
from softfin.storage.run_directory import Workspace

TOKEN = "here"
"""File by which a worker tells whether it sees the folder that it was told of, and not one of the same name."""


class Job(NamedTuple):
    """A part of a run."""

    config: TrainConfig
    """Of the whole run, less the cells that are not the job's."""
    seeds: tuple[int, ...]


class Finished(NamedTuple):
    """What a job sends back."""

    policies: Policy
    """As in `Trained`, of the job's lanes."""
    score: Score
    files: Mapping[str, bytes]
    """Of a workspace that is not the driver's own: its checkpoint and logs."""


def default_split(engine: EngineName, seeds: Sequence[int]) -> Split:
    """One program is fastest on one machine; on many, the whole of a seed goes to one as long as there are several."""
    if engine == "local":
        return "none"
    return "seed" if len(seeds) > 1 else "cell"


def jobs_of(config: TrainConfig, seeds: Sequence[int], split: Split) -> dict[str, Job]:
    """By name, seeds before cells."""
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
    workspace: Workspace,
    progress: Progress | None = None,
    *,
    engine: Engine | None = None,
    split: Split = "none",
    known: ForceMap | None = None,
) -> Trained:
    """As `train`, in jobs on an engine; the fin is mapped once for all of them, where what it can do is not `known`.

    Raises:
        ConfigurationError: as `train`.
        RunError: a job failed; the last good checkpoints of all are left in the workspace.
    """
    check(plant, config, seeds, known)
    known = mapped(plant, config, workspace, progress) if known is None else known
    start = common_start(plant, config, seeds, workspace, progress, known)
    jobs, token = jobs_of(config, seeds, split), uuid4().hex
    starts = _starts(start, split, list(jobs.values()))
    placed = {}
    for (name, job), begun in zip(jobs.items(), starts, strict=True):
        folder = workspace if split == "none" else workspace.part(name)
        write_file(folder.folder / TOKEN, token)
        placed[name] = _Placed(job, folder, token, begun)
    stage = f"train {config.controller}"
    done = (engine or LocalEngine()).map(stage, _Training(plant, known), placed, progress)
    for place, finished in zip(placed.values(), done, strict=True):
        for file, data in finished.files.items():
            write_file(place.workspace.folder / file, data)
    policies, score = _together([(part.policies, part.score) for part in done], len(seeds) if split != "none" else 1)
    return Trained(config, Limits(*map(float, plant.limits)), tuple(seeds), policies, score, known)


def _starts(start: Policy | None, split: Split, jobs: Sequence[Job]) -> list[Policy | None]:
    """What each job begins from, of policies with leaves ``(seeds, cells, ...)``."""
    if start is None or split == "none":
        return [start] * len(jobs)
    rows = len(start.log_deviation)
    across = len(jobs) // rows

    def part(index: int) -> Policy:
        seed, cell = divmod(index, across)
        cells = slice(None) if split == "seed" else slice(cell, cell + 1)
        chosen: Policy = jax.tree.map(lambda leaf: leaf[seed : seed + 1, cells], start)
        return chosen

    return [part(index) for index in range(len(jobs))]


class _Placed(NamedTuple):
    """A job, and where its unfinished work lies."""

    job: Job
    workspace: Workspace
    token: str
    start: Policy | None
    """What it begins from, where another run was before."""


@dataclass(frozen=True)
class _Training:
    """What is done to a job; the plant travels as arrays and the name of its class."""

    plant: Plant
    known: ForceMap | None

    def __call__(self, placed: _Placed, progress: Progress | None) -> Finished:
        """Train, from the last checkpoint where this machine sees it."""

        def trained(workspace: Workspace) -> Trained:
            job = placed.job
            return train(self.plant, job.config, job.seeds, workspace, progress, known=self.known, start=placed.start)

        if _sees(placed.workspace.folder, placed.token):
            ended = trained(placed.workspace)
            return Finished(ended.policies, ended.score, {})
        return _elsewhere(placed.workspace, trained)


def _sees(folder: Path, token: str) -> bool:
    try:
        return (folder / TOKEN).read_text() == token
    except OSError:
        return False


def _elsewhere(workspace: Workspace, trained: Callable[[Workspace], Trained]) -> Finished:
    """In a folder that is this machine's own; what it holds in the end goes home with the result."""
    folder = Path(tempfile.mkdtemp(prefix="softfin-"))
    own = copy.copy(workspace)
    own.folder = folder
    try:
        ended = trained(own)
        files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        return Finished(ended.policies, ended.score, files)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _together(parts: Sequence[Any], rows: int) -> Any:
    """Trees of leaves ``(seeds, cells, ...)``, put together by `rows` of seeds."""
    cells = len(parts) // rows
    across = [jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts[i * cells : (i + 1) * cells])
              for i in range(rows)]  # fmt: skip
    return jax.tree.map(lambda *x: np.concatenate(x, axis=0), *across)
