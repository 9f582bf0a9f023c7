"""Training runs: a plant, a configuration and seeds in; one deterministic policy per seed and cell out.

A run is trained in jobs, a part of its seeds and cells each, on any engine. A job is a run of its own with its own
checkpoints; resumed, it ends with the same weights as one that was never stopped. Its result depends on its seeds and
cells alone, so with the same split all engines give the same bits. Another split gives agents of the same keys in
programs of another width, which round differently.
"""

import copy
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

import jax
import numpy as np

from softfin.core.choices import EngineName, Split
from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import Limits
from softfin.gaits.force_map import empty_map, map_forces
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import Reachable
from softfin.learning.configuration import TrainConfig, check
from softfin.learning.engine import Engine
from softfin.learning.run import BestPolicies, TrainingResult, TrainingRun, keep_best, summary, with_keys, without_keys
from softfin.storage.artifact import write_file
from softfin.storage.run_directory import RunDirectory

TOKEN = "here"
"""File by which a worker recognises the driver's folder, and not one of the same name."""


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

    Without a `force_map` the fin is mapped, where a map is needed, once for all jobs. Raises ConfigurationError
    as `check`, RunError where a job failed; the last good checkpoints of all are left.
    """
    check(plant, config, seeds, force_map)
    force_map = find_map(plant, config, run_directory, progress) if force_map is None else force_map
    token, jobs = uuid4().hex, {}
    for name, at in split_run(config, seeds, split).items():
        part = run_directory if split == "none" else run_directory.part(name)
        write_file(part.folder / TOKEN, token)
        own = config.model_copy(update={"cells": config.cells[at[1]]})
        jobs[name] = Job(own, tuple(seeds)[at[0]], part, token)
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
) -> tuple[BestPolicies, dict[str, bytes]]:
    """Train, from the last checkpoint where the driver's folder is the same here.

    Elsewhere the work is done in a folder of this machine's own, whose files are sent back with the result.
    """
    file = job.run_directory.folder / TOKEN
    if file.is_file() and file.read_text() == job.token:
        return train(plant, job.config, job.seeds, job.run_directory, progress, force_map), {}
    own = copy.copy(job.run_directory)
    with tempfile.TemporaryDirectory(prefix="softfin-", ignore_cleanup_errors=True) as name:
        own.folder = folder = Path(name)
        result = train(plant, job.config, job.seeds, own, progress, force_map)
        files = (path for path in folder.rglob("*") if path.is_file())
        return result, {str(path.relative_to(folder)): path.read_bytes() for path in files}


def train(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None,
    force_map: ForceMap | None,
) -> BestPolicies:
    """Train a policy for every seed and cell; continue from the checkpoint in run_directory if there is one.

    Raises RunError where a loss is no longer finite; the last good checkpoint is left in the run_directory.
    """
    run = TrainingRun(plant, config, tuple(seeds), force_map)
    state, done, steps_per_update = run.start(), 0, config.learning.steps_per_update
    if (resumed := run_directory.load(without_keys(state))) is not None:
        state, done = with_keys(resumed[0], state), resumed[1]["updates"]
    state = state._replace(agents=run.over_devices(state.agents))
    record = run_directory.log(rewind_to=done * steps_per_update)
    count = min(config.num_evaluations, config.num_updates)
    due = {round(config.num_updates * (i + 1) / count) for i in range(count)}
    while done < config.num_updates:
        done += 1
        agents, metrics = run.update(state.agents, done)
        state, scalars = state._replace(agents=agents), run.by_seed(metrics)
        if done in due:
            evaluation = run.evaluate(agents.policy, done)
            state, scalars = keep_best(state, evaluation), scalars | run.by_seed(summary(evaluation))
        # Before the checkpoint: a resumed run drops entries that are too many, but cannot make up for one.
        record.write(done * steps_per_update, **scalars)
        if done in due:
            run_directory.save(without_keys(state), {"updates": done})
        if progress is not None:
            progress(f"train {config.controller}", done / config.num_updates, run.note(metrics, state))
    record.close()
    return run.result(state)


def find_map(
    plant: Plant, config: TrainConfig, run_directory: RunDirectory, progress: Progress | None
) -> ForceMap | None:
    """Map the forces of a fin whose policies begin as gaits, or read the map of a stopped run; None of other runs."""
    if not config.begins_as_gaits:
        return None
    settings = config.gradient.map.merged({"box": config.training_range.model_dump()}, "cells")
    part = run_directory.part("map")
    coarse = settings.empty_table(Reachable(np.zeros(2), np.ones(settings.survey.directions)))
    like = empty_map(coarse.halved(settings.gaits.halvings), settings.survey.directions)
    if (resumed := part.load(like)) is not None:
        stored: ForceMap = jax.tree.map(np.asarray, resumed[0])
        return stored
    found = map_forces(plant, settings, None if progress is None else partial(progress, "map"))
    part.save(found, {})
    return found
