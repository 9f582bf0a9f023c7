"""One job of a training run: a plant, a configuration and seeds in; one deterministic policy per seed and cell out.

Every few updates the policies are evaluated without their noise, the best ones so far kept, and a checkpoint written; a
resumed run ends with the same weights as one that was never stopped.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.gaits.force_map import empty_map, map_forces
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import Reachable, bounding_box
from softfin.learning.configuration import TrainConfig
from softfin.learning.figure import SHARED
from softfin.learning.policy import Policy
from softfin.learning.run import TrainingResult, TrainingRun, keep_best, summary, with_keys, without_keys
from softfin.storage.run_directory import RunDirectory


def train(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None,
    force_map: ForceMap | None,
    start: Policy | None = None,
) -> TrainingResult:
    """Train a policy for every seed and cell; goes on from the run_directory's checkpoint where there is one.

    Agents that `start` from policies, leaves ``(seeds, cells, ...)``, never end with a greater error than these.
    Raises RunError where a loss is no longer finite; the last good checkpoint is left in the run_directory.
    """
    run = TrainingRun(plant, config, tuple(seeds), force_map)
    state, done, steps_per_update = run.start(start), 0, config.learning.steps_per_update
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


def pretrain_shared_policy(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None,
    force_map: ForceMap | None,
) -> Policy | None:
    """Train one policy for all cells of a grid, which its policies begin as; leaves ``(seeds, cells, ...)``.

    They specialise from there, so neighbours move in phase, and what holds for all cells is learnt once. None where
    the configuration has no such training.
    """
    shared = config.gradient.shared_pretraining
    if config.algorithm != "gradient" or config.controller != "grid" or shared is None:
        return None
    whole = config.merged(
        {
            "controller": "single", "cells": [bounding_box(config.cells).model_dump()], "lattice": shared.lattice,
            "steps": shared.num_updates * shared.num_envs * config.gradient.num_steps,
            "gradient": {
                "num_envs": shared.num_envs, "learning_rate": shared.learning_rate, "shared_pretraining": None,
            },
        },
        "shared_pretraining",
    )  # fmt: skip
    result = train(plant, whole, seeds, run_directory.part(SHARED), progress, force_map)
    policies: Policy = jax.tree.map(lambda leaf: jnp.repeat(leaf, len(config.cells), axis=1), result.policies)
    return policies


def find_map(
    plant: Plant, config: TrainConfig, run_directory: RunDirectory, progress: Progress | None
) -> ForceMap | None:
    """Map the forces of a fin whose policies begin as gaits, or read the map of a stopped run; None of other runs."""
    if not config.begins_as_gaits:
        return None
    settings = config.gradient.map.merged({"box": config.training_range.model_dump()}, "cells")
    part = run_directory.part("map")
    table = settings.empty_table(Reachable(np.zeros(2), np.ones(settings.survey.directions)))
    if (resumed := part.load(empty_map(table, settings.survey.directions))) is not None:
        stored: ForceMap = jax.tree.map(np.asarray, resumed[0])
        return stored
    found = map_forces(plant, settings, None if progress is None else partial(progress, "map"))
    part.save(found, {})
    return found
