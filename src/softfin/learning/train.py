"""Trains one deterministic policy per seed and cell, for a plant and a configuration.

All agents of a run are trained in one compiled program. A resumed run ends with the same weights as
an uninterrupted run.
"""

from collections.abc import Sequence
from functools import partial

import jax
import numpy as np

from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.core.quantities import Limits
from softfin.gaits.force_map import empty_map, find_force_map
from softfin.gaits.gait import FinForces, ForceMap
from softfin.gaits.reachable import Reachable
from softfin.gaits.simulate import Survey
from softfin.learning.configuration import TrainConfig, check
from softfin.learning.run import (
    TrainingResult,
    TrainingRun,
    keep_best,
    summary,
    with_keys,
    without_keys,
)
from softfin.storage.run_directory import RunDirectory


def train(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None = None,
    forces: FinForces | None = None,
) -> TrainingResult:
    """Train a policy for each seed and cell; resume from the checkpoint in `run_directory`, if any.

    If policies start from gaits and `forces` contains none, the fin is mapped first.

    Raises:
        ConfigurationError: `check` failed.
        RunError: a loss is not finite; the last valid checkpoint is kept in `run_directory`.
    """
    forces = checked_forces(plant, config, seeds, run_directory, progress, forces)
    run = TrainingRun(plant, config, tuple(seeds), forces)
    state = run.start()
    done = 0
    steps_per_update = run.config.learning.steps_per_update
    if (resumed := run_directory.load(without_keys(state))) is not None:
        state = with_keys(resumed[0], state)
        done = resumed[1]["updates"]
    state = state._replace(agents=run.over_devices(state.agents))
    record = run_directory.log(rewind_to=done * steps_per_update)
    count = min(config.num_evaluations, config.num_updates)
    # Evenly spaced updates, including the last one.
    due = {round(config.num_updates * (i + 1) / count) for i in range(count)}
    while done < config.num_updates:
        done += 1
        agents, metrics = run.update(state.agents, done)
        state = state._replace(agents=agents)
        scalars = run.by_seed(metrics)
        if done in due:
            evaluation = run.evaluate(agents.policy, done)
            state = keep_best(state, evaluation)
            scalars |= run.by_seed(summary(evaluation))
        # Written before the checkpoint: a resumed run can remove surplus entries, but cannot
        # restore missing ones.
        record.write(done * steps_per_update, **scalars)
        if done in due:
            run_directory.save(without_keys(state), {"updates": done})
        if progress is not None:
            progress(
                f"train {config.controller}", done / config.num_updates, run.note(metrics, state)
            )
    policies, evaluation = run.result(state)
    limits = Limits(*map(float, plant.limits))
    return TrainingResult(config, limits, tuple(seeds), policies, evaluation, run.reachable)


def checked_forces(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None,
    forces: FinForces | None,
) -> FinForces | None:
    """Check a run with `check`, and return the forces of the fin; find gaits for them if policies
    start from gaits and there are none."""
    check(plant, config, seeds, forces)
    if forces is None and config.begins_as_gaits:
        forces = find_gaits(plant, config, run_directory, progress)
        check(plant, config, seeds, forces)
    return forces


def find_gaits(
    plant: Plant,
    config: TrainConfig,
    run_directory: RunDirectory,
    progress: Progress | None,
    surveyed: Survey | None = None,
) -> FinForces:
    """Find gaits for all references of a configuration, or load those of an interrupted run.

    After a survey, references that it found to be unreachable get no gaits.
    """
    box = config.training_range
    # Without a survey, only the shapes matter here, and the box determines them.
    region = Reachable(np.zeros(2), np.ones(config.gradient.map.survey.directions))
    if surveyed is not None:
        region = surveyed.reachable
        box = box.clipped(*map(np.array, region.bounds()))
    values = {"box": box.model_dump(), "clock": config.task.clock.model_dump()}
    settings = config.gradient.map.merged(values, "task")
    part = run_directory.part("map")
    coarse = settings.empty_table(region)
    like = empty_map(
        coarse.halved(settings.gaits.halvings), settings.survey.directions, settings.clock
    )
    if (resumed := part.load(like)) is not None:
        stored: ForceMap = jax.tree.map(np.asarray, resumed[0])
        return stored.forces
    report = None if progress is None else partial(progress, "map")
    found = find_force_map(plant, settings, report, surveyed)
    part.save(found, {})
    return found.forces
