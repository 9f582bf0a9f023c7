"""Stages that evaluate or show a moving fin: with a controller (paper Sec. IV-B), as a video or a
page."""

from collections.abc import Sequence
from pathlib import Path

from softfin.control.controller import Controller
from softfin.control.references import resolve_reference
from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.evaluation.evaluate import (
    EvaluateConfig,
    score_controller,
    write_evaluation,
)
from softfin.evaluation.experiment import EvaluationTarget
from softfin.evaluation.results import EvaluationSummary
from softfin.evaluation.view.files import shown_ticks
from softfin.evaluation.view.view import ViewConfig, draw, record_footage, view_title
from softfin.storage import artifact as artifacts
from softfin.storage.paths import check_view
from softfin.storage.registry import find_plant, plant_name
from softfin.tank import DomainRandomization, RandomizedTank, Tank


def evaluate(
    controller: Path,
    plant: str | EvaluationTarget,
    out: Path | None = None,
    config: EvaluateConfig | None = None,
    *,
    randomize: float | int | DomainRandomization | None = None,
    overwrite: bool = False,
) -> EvaluationSummary:
    """Evaluate a controller on a plant (paper Sec. IV-B, Table II); writes ``evaluation.json`` and
    figures to `out`.

    `randomize` requires a tank as plant: every repetition runs in a different, randomly perturbed
    tank. With 0, all repetitions run in the tank itself.
    """
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    widths = (
        DomainRandomization.of(float(randomize))
        if isinstance(randomize, int | float)
        else randomize
    )
    if widths is not None:
        if not isinstance(moving, Tank):
            raise ConfigurationError(
                f"--randomize {randomize}: requires the virtual tank as plant, got {plant!r}"
            )
        # At 0, use the tank itself: RandomizedTank would also change the sensor's noise.
        moving = moving if widths.is_none else RandomizedTank(moving, widths)
    loaded = load_controller(controller)
    check_limits(loaded.limits, moving.limits, controller, str(plant))
    evaluation = score_controller(loaded, moving, config or EvaluateConfig())
    if out is None:
        return evaluation.summary()
    metadata = {
        "controller": str(controller),
        "kind": loaded.kind,
        "plant": str(plant),
        "randomization": None if widths is None else widths.model_dump(mode="json"),
    }
    return write_evaluation(evaluation, out, metadata, overwrite)


def check_limits(asked: Limits, taken: Limits, controller: Path, named: str) -> None:
    """Raise PlantError if a controller's commands exceed the plant's limits."""
    for i, quantity in ((0, "angle"), (2, "velocity")):
        ours = asked[i : i + 2]
        theirs = taken[i : i + 2]
        tolerance = 1e-3 * (theirs[1] - theirs[0])
        if ours[0] < theirs[0] - tolerance or ours[1] > theirs[1] + tolerance:
            raise PlantError(
                f"{controller}: commands a {quantity} of {ours[0]:.3g} .. {ours[1]:.3g}, but "
                f"{named} accepts {theirs[0]:.3g} .. {theirs[1]:.3g}; train it in a "
                "surrogate of this plant"
            )


def _resolve(
    controller: Controller, references: Sequence[tuple[float, float]]
) -> tuple[list[tuple[float, float]], list[str]]:
    """Return the references that the controller tracks, and warnings about replaced ones."""
    forces = []
    warnings = []
    for asked in references:
        force, warning = resolve_reference(controller, asked, strict=False)
        forces.append(force)
        if warning is not None:
            warnings.append(warning)
    return forces, warnings


def view(
    plant: str | Plant,
    out: Path,
    config: ViewConfig | None = None,
    *,
    controller: Path | None = None,
    reference: tuple[float, float] | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Show a plant in motion as .gif, .html or .png, with a simple gait or a controller."""
    config = config or ViewConfig()
    check_view(out, overwrite)
    moving = find_plant(plant)
    if (controller is None) != (reference is None):
        raise ConfigurationError(
            "a controller needs a reference, and vice versa; use both or neither"
        )
    warnings: list[str] = []
    loaded = None
    if controller is not None and reference is not None:
        if config.random:
            raise ConfigurationError(
                "random commands and a controller cannot be combined; use one of them"
            )
        loaded = load_controller(controller)
        (reference, *following), warnings = _resolve(loaded, (reference, *config.next_references))
        config = config.merged({"next_references": following}, "view")
        check_limits(loaded.limits, moving.limits, controller, plant_name(plant))
    title = view_title(plant_name(plant), config, reference)
    progress("view", 0.0, "")
    footage = record_footage(moving, config, loaded, reference)
    draw(footage, out, title, config, lambda done: progress("view", done, ""))
    return {
        "view": str(out),
        "title": title,
        "seconds": config.seconds,
        "frames": len(shown_ticks(len(footage.shape), config.frames_per_second))
        if out.suffix == ".gif"
        else None,
        "mean_force_n": [round(float(force), 4) for force in footage.force.mean(axis=0)],
        "force": "reading" if footage.true_force is None else "true force",
        "shape_known": footage.shape_known,
        "warning": "; ".join(warnings) or None,
    }
