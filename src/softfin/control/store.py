"""Read and write controller folders.

A folder contains ``controller.json`` (kind, cells, task, limits, provenance) and
``weights.safetensors``.
"""

import hashlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pydantic

from softfin.control.controller import Artifact, LoadedController, TrainingRange
from softfin.control.family import load_family
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.gait import GaitStep
from softfin.control.grid import GridStep
from softfin.control.single import SingleStep
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ArtifactError, one_line
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, NamedArrays
from softfin.gaits.reachable import Cell, Reachable
from softfin.storage import artifact as artifacts

CONTROLLER_KIND = "controller"
AGAIN = "copy the folder again, or run softfin map or train again"
"""Suggested fix for a damaged folder."""

CONTROLLER_STEPS: Mapping[str, Any] = {step.kind: step for step in (SingleStep, GridStep, GaitStep)}
"""Step classes by kind of controller."""


def load_controller(path: str | Path) -> LoadedController:
    """Load a controller. It runs without JAX; if JAX is already imported, compiled functions can
    take it as an argument.

    Args:
        path: Folder of the controller.

    Returns:
        The controller.

    Raises:
        ArtifactError: If the folder is missing or damaged.

    Example:
        >>> controller = softfin.load_controller("gaits")
    """
    if "jax" in sys.modules:
        from softfin.control.pytrees import register_controllers

        register_controllers()
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


def load_feedback(
    path: Path, controller: LoadedController, config: FeedbackConfig | None
) -> LoadedController | Feedback:
    """Return the controller with feedback, which uses the family in the controller folder if there
    is one. Without `config`, return the controller itself."""
    if config is None:
        return controller
    return Feedback(controller, config, load_family(path, controller))


def build_controller(
    description: Mapping[str, Any],
    arrays: NamedArrays,
    source: str,
    name: str,
    digest: str,
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
        clock = ActionClock.model_validate(description["clock"])
        has_gaits = kind == GaitStep.kind
        region = description.get("reachable")
        # Gait controllers store no cells; theirs is the bounding box of their lattice.
        listed = [] if has_gaits else description["cells"]
        cells = tuple(map(Cell.model_validate, listed))
        weights = {name: np.array(array, np.float32) for name, array in arrays.items()}
        step, cells = CONTROLLER_STEPS[kind].load(description, weights, limits, cells)
        learnt = pydantic.TypeAdapter(TrainingRange | None).validate_python(
            description.get("training_range")
        )
        fin = pydantic.TypeAdapter(str | None).validate_python(description.get("fin"))
        needs_region = has_gaits or region is not None
        reachable = Reachable.from_dict(region) if needs_region else None
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
    extra_files: Callable[[Path], None],
    overwrite: bool,
    clock: ActionClock,
) -> None:
    """Write a controller completely or not at all.

    `keys` and `arrays` depend on the kind of controller; `extra_files` writes additional files into
    the folder.
    """
    description = {
        "controller": kind,
        "clock": clock.model_dump(mode="json"),
        "limits": limits.to_dict(),
        **keys,
    }
    artifacts.save(path, CONTROLLER_KIND, description, dict(arrays), extra_files, overwrite)


def save_gaits(
    path: Path,
    force_map: ForceMap,
    tolerance_n: float,
    limits: Limits,
    keys: Mapping[str, object],
    overwrite: bool = False,
) -> None:
    """Write the gaits of a map as a controller with the figure ``map.png``, completely or not at
    all.

    `tolerance_n` is the maximum force error of a gait whose force is treated as reachable; `keys`
    are additional entries of ``controller.json``.
    """
    # Imported here because importing Matplotlib takes time and is not needed to read a controller.
    from softfin.gaits.figure import map_figure
    from softfin.storage.figures import save_figure

    figure = map_figure(force_map, tolerance_n)

    write_controller(
        path,
        GaitStep.kind,
        limits,
        {**force_map.to_dict(), **keys},
        force_map.arrays(),
        lambda folder: save_figure(figure, folder / "map.png"),
        overwrite,
        force_map.clock,
    )
