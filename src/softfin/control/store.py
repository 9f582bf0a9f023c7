"""Read and write controller folders.

A folder contains ``controller.json`` (kind, cells, task, limits, provenance) and
``weights.safetensors``.
"""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pydantic

from softfin.control.controller import Artifact, LoadedController, TrainingRange
from softfin.control.gait import GaitStep
from softfin.control.grid import GridStep
from softfin.control.single import SingleStep
from softfin.core.action_clock import ActionClock
from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, one_line
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, NamedArrays
from softfin.gaits.reachable import Cell, Reachable
from softfin.storage import artifact as artifacts

CONTROLLER_KIND = "controller"
AGAIN = "copy the folder again, or train it again"
"""Suggested fix for a damaged folder."""

CONTROLLER_STEPS: Mapping[str, Any] = MappingProxyType(
    {step.kind: step for step in (SingleStep, GridStep, GaitStep)}
)
"""Step classes by kind of controller."""


def load_controller(path: Path) -> LoadedController:
    """Load the controller from a folder; raises ArtifactError if it is missing or damaged."""
    path = Path(path)
    description, arrays = artifacts.load(path, CONTROLLER_KIND)
    digest = hashlib.sha256((path / artifacts.WEIGHTS).read_bytes()).hexdigest()
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ArtifactError(
                f"{path / artifacts.WEIGHTS}: {name[:80]!r} contains numbers that are not finite; "
                f"{AGAIN}"
            )
    return build_controller(
        description, arrays, str(path / f"{CONTROLLER_KIND}.json"), path.resolve().name, digest
    )


def build_controller(
    description: Mapping[str, Any],
    arrays: NamedArrays,
    source: str,
    name: str = CONTROLLER_KIND,
    digest: str = "",
) -> LoadedController:
    """Build a controller from its description and arrays; error messages start with `source`."""
    kind = str(description.get("controller"))
    if kind not in CONTROLLER_STEPS:
        raise ArtifactError(
            f"{source}: controller is {kind[:80]!r}, must be one of "
            f"{', '.join(CONTROLLER_STEPS)}; {AGAIN}"
        )
    try:
        limits = Limits.of(description["limits"])
        clock = ActionClock.model_validate(description.get("clock", {}))
        # Versions before 0.1 stored the rate alone, that of the paper's clock.
        rate_hz = description["action_rate_hz"]
        if rate_hz != clock.rate_hz:
            raise ValueError(f"action_rate_hz is {rate_hz!r}, but the clock's is {clock.rate_hz:g}")
        region = description.get("reachable")
        # Gait controllers store no cells; theirs is the bounding box of their lattice.
        listed = [] if kind == GaitStep.kind else description["cells"]
        cells = tuple(map(Cell.model_validate, listed))
        weights = {name: np.array(array, np.float32) for name, array in arrays.items()}
        step, cells = CONTROLLER_STEPS[kind].load(description, weights, limits, cells)
        learnt = pydantic.TypeAdapter(TrainingRange | None).validate_python(
            description.get("training_range")
        )
        fin = pydantic.TypeAdapter(str | None).validate_python(description.get("fin"))
        reachable = None if region is None else Reachable.from_dict(region)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        at = ".".join(map(str, first["loc"])) or error.title
        raise ArtifactError(
            f"{source}: {at} is {str(first['input'])[:80]}: {first['msg']}; {AGAIN}"
        ) from None
    except (KeyError, TypeError, ValueError) as error:
        problem = f"{error.args[0]} is missing" if isinstance(error, KeyError) else one_line(error)
        raise ArtifactError(f"{source}: {problem}; {AGAIN}") from None
    return LoadedController(
        step, limits, cells, reachable, Artifact(name, learnt, fin, description, digest), clock
    )


def write_controller(
    path: Path,
    kind: str,
    limits: Limits,
    keys: Mapping[str, object],
    arrays: NamedArrays,
    extra_files: Callable[[Path], None] | None,
    overwrite: bool,
    clock: ActionClock,
) -> None:
    """Write a controller completely or not at all.

    `keys` and `arrays` depend on its kind; `extra_files` writes more files into the folder.
    """
    description = {
        "controller": kind,
        "action_rate_hz": clock.rate_hz,
        "clock": clock.model_dump(mode="json"),
        "limits": limits.to_dict(),
        **keys,
    }
    artifacts.save(path, CONTROLLER_KIND, description, dict(arrays), extra_files, overwrite)


def save_gaits(
    path: Path,
    force_map: ForceMap,
    config: Configuration,
    limits: Limits,
    provenance: Mapping[str, object],
    extra_files: Callable[[Path], None] | None = None,
    learnt: Mapping[str, object] = MappingProxyType({"training_range": None, "fin": None}),
    overwrite: bool = False,
) -> None:
    """Write the gaits of a map as a controller, completely or not at all.

    `extra_files` writes more files into the folder. `learnt` describes the training data of its
    plant (`softfin.surrogate.channels.learnt_from`).
    """
    gaits = force_map.gaits
    error = gaits.force_error()
    nodes = gaits.table.references()
    keys = {
        **force_map.to_dict(),
        **learnt,
        "scores": [
            {
                "reference_n": nodes[place].tolist(),
                "missed_n": round(float(error[place]), 4),
                "smoothness_n": gaits.smoothness[place].round(4).tolist(),
            }
            for place in np.ndindex(error.shape)
        ],
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }
    write_controller(
        path,
        GaitStep.kind,
        limits,
        keys,
        force_map.arrays(),
        extra_files,
        overwrite,
        force_map.clock,
    )
