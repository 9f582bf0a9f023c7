"""A controller's folder: ``controller.json`` (cells, task, limits, scores, provenance) and ``weights.safetensors``."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
import pydantic

from softfin.control.gait import GaitController
from softfin.control.grid import GridController
from softfin.control.single import SingleController
from softfin.core.action_clock import ACTION_RATE_HZ
from softfin.core.errors import ArtifactError
from softfin.core.quantities import Limits
from softfin.gaits.force_map import ForceMap, MapConfig
from softfin.gaits.map_store import arrays, described, found_of
from softfin.gaits.reachable import Reachable
from softfin.learning.policy import Policy, PolicyConfig, memory_of, named
from softfin.learning.run import TrainingResult
from softfin.storage import artifact as artifacts
from softfin.surrogate.range import UNKNOWN
from softfin.task.references import Cell
from softfin.task.switching import SwitchingConfig
from softfin.task.task import TaskConfig

KIND = "controller"
FORMAT = 2
AGAIN = "copy the folder again, or train it again"
"""What helps where a folder is no longer what was written."""


def controller_of(trained: TrainingResult, seed: int) -> SingleController | GridController:
    """The controller that a run trained from one of its seeds."""
    index = trained.seeds.index(seed)
    policies = _taken(trained.policies, index)
    config, reachable = trained.config, None if trained.force_map is None else trained.force_map.reachable
    if config.controller == "single":
        policy = _taken(policies, 0)
        return SingleController(policy, config.task, trained.limits, config.cells[0], reachable)
    return GridController(policies, config.task, trained.limits, config.cells, reachable, config.switching)


def _taken(policies: Policy, index: int) -> Policy:
    """One along the leading axis."""
    # Each shape that JAX itself took an element of would be a program.
    taken: Policy = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[index]), policies)
    return taken


def save_controller(
    path: Path,
    trained: TrainingResult,
    seed: int,
    provenance: dict[str, Any],
    also: Callable[[Path], None] | None = None,
    learnt: Mapping[str, Any] = UNKNOWN,
    overwrite: bool = False,
) -> None:
    """Write the controller of one seed, whole or not at all; `also` adds files to the folder.

    `learnt` is what its plant learnt from (`softfin.surrogate.range.learnt_from`).
    """
    config = trained.config
    index = trained.seeds.index(seed)
    controller = controller_of(trained, seed)
    policy = controller.policy if isinstance(controller, SingleController) else controller.policies
    description = {
        "kind": KIND,
        "format": FORMAT,
        "controller": config.controller,
        "action_rate_hz": ACTION_RATE_HZ,
        "limits": trained.limits.described(),
        "cells": [cell.model_dump(mode="json") for cell in config.cells],
        "task": config.task.model_dump(mode="json"),
        "policy": config.policy.model_dump(mode="json"),
        "reachable": None if controller.reachable is None else controller.reachable.described(),
        **learnt,
        "switching": controller.switching.model_dump(mode="json") if isinstance(controller, GridController) else None,
        "memory": memory_of(policy),
        "scores": _scores(trained, index),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }
    artifacts.save(
        path, KIND, description, {name: np.asarray(leaf) for name, leaf in named(policy).items()}, also, overwrite
    )


def save_gaits(
    path: Path,
    known: ForceMap,
    config: MapConfig,
    limits: Limits,
    provenance: dict[str, Any],
    also: Callable[[Path], None] | None = None,
    learnt: Mapping[str, Any] = UNKNOWN,
    overwrite: bool = False,
) -> None:
    """Write a map's gaits as a controller; likewise."""
    table = known.found.table
    missed, nodes = known.found.missed(), table.references()
    description = {
        "kind": KIND,
        "format": FORMAT,
        "controller": "gaits",
        "action_rate_hz": ACTION_RATE_HZ,
        "limits": limits.described(),
        **described(known),
        **learnt,
        "scores": [
            {"reference_n": nodes[place].tolist(), "missed_n": round(float(missed[place]), 4),
             "smoothness_n": known.found.smoothness[place].round(4).tolist()}
            for place in np.ndindex(missed.shape)
        ],
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }  # fmt: skip
    artifacts.save(path, KIND, description, arrays(known.found), also, overwrite)


AnyController: TypeAlias = SingleController | GridController | GaitController


def load_controller(path: Path) -> AnyController:
    """The controller in a folder; raises ArtifactError where it is none, or no longer a whole one."""
    description, weights = artifacts.load(path, KIND)
    source = str(path / f"{KIND}.json")
    _check_current(description, source)
    if description.get("controller") == "gaits":
        try:
            found, within = found_of(description, weights), Reachable.of(description["reachable"])
            return GaitController(found.table, Limits.of(description["limits"]), within)
        except (KeyError, TypeError, ValueError) as error:
            raise ArtifactError(_harmed(source, error)) from None
    try:
        kind = description["controller"]
        cells = tuple(Cell.model_validate(cell) for cell in description["cells"])
        task = TaskConfig.model_validate(description["task"])
        stored = description["policy"].items()
        # The name of earlier versions.
        config = PolicyConfig.model_validate({"init_std" if k == "deviation" else k: value for k, value in stored})
        limits = Limits.of(description["limits"])
        switching = SwitchingConfig.model_validate(description["switching"] or {})
        region = description.get("reachable")
        reachable = None if region is None else Reachable.of(region)
    except (KeyError, TypeError, ValueError, pydantic.ValidationError) as error:
        raise ArtifactError(_harmed(source, error)) from None
    policy = Policy.from_arrays(config, task.observations, weights, str(path / artifacts.WEIGHTS))
    stacked = policy.log_std.shape[:-1]
    if kind == "single" and len(cells) == 1 and stacked == ():
        return SingleController(policy, task, limits, cells[0], reachable)
    if kind == "grid" and stacked == (len(cells),):
        return GridController(policy, task, limits, cells, reachable, switching)
    raise ArtifactError(
        f"{source}: controller {kind!r} with {len(cells)} cells does not fit weights of {stacked or 1} policies; "
        "there are single (one), grid (one a cell) and gaits; copy the folder again"
    )


def _check_current(description: dict[str, Any], source: str) -> None:
    for name in ("format", "action_rate_hz"):
        if name not in description:
            raise ArtifactError(f"{source}: says no {name}; {AGAIN}")
    written, rate = description["format"], description["action_rate_hz"]
    if written != FORMAT:
        raise ArtifactError(f"{source}: format {written}; this softfin reads {FORMAT}; update it, or train it again")
    if rate != ACTION_RATE_HZ:
        raise ArtifactError(f"{source}: acts at {rate} Hz; softfin acts at {ACTION_RATE_HZ} Hz; train it again")


def _harmed(source: str, error: Exception) -> str:
    return f"{source}: not a controller's description ({' '.join(str(error).split())}); {AGAIN}"


def _scores(trained: TrainingResult, index: int) -> list[dict[str, Any]]:
    """Of each cell: its references and the forces that were held for them, in the plant that it was trained in.

    Errors are against ``held_n``, the nearest force that the fin can make, where what it can do is known.
    With ``beyond_data``, the share of actions that led beyond its data, where that plant is a surrogate that knows.
    """
    scored, held, rows = trained.evaluation, trained.evaluation_references(), []
    outside = scored.out_of_distribution_fraction
    for i, cell in enumerate(trained.config.cells):
        for j, reference in enumerate(cell.lattice(trained.config.lattice)):
            error, deviation = (np.asarray(part)[index, i, j] for part in (scored.error, scored.std))
            known = {} if outside is None else {"beyond_data": float(outside[index, i, j])}
            rows.append(
                {
                    "cell": i,
                    "reference_n": list(reference),
                    "held_n": [round(float(x), 4) for x in held[i, j]],
                    "error_n": [round(float(x), 4) for x in error],
                    "std_n": [round(float(x), 4) for x in deviation],
                    **known,
                }
            )
    return rows
