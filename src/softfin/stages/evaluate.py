"""Evaluate a controller on a plant (paper Sec. IV-B)."""

from pathlib import Path
from typing import Any

from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.quantities import Limits
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation, write_evaluation
from softfin.evaluation.evaluate import evaluate as _evaluate
from softfin.evaluation.experiment import EvaluationTarget
from softfin.storage import artifact as artifacts
from softfin.storage.registry import find_plant
from softfin.tank import DomainRandomization, RandomizedTank, Tank


def evaluate(
    controller: Path,
    plant: str | EvaluationTarget,
    out: Path | None = None,
    config: EvaluateConfig | None = None,
    *,
    randomize: float | int | DomainRandomization | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Evaluate a controller on a plant (paper Sec. IV-B, Table II); writes ``evaluation.json`` and figures to `out`.

    With `randomize` the plant must be a tank; every repetition is run in another one, drawn about it; 0 is the tank.
    """
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    moving = find_plant(plant) if isinstance(plant, str) else plant
    widths = DomainRandomization.of(float(randomize)) if isinstance(randomize, int | float) else randomize
    if widths is not None:
        if not isinstance(moving, Tank):
            raise ConfigurationError(f"--randomize {randomize} needs the virtual tank as plant, got {plant!r}")
        # At 0 the sensor's noise is the tank's own, too.
        moving = moving if widths.is_none else RandomizedTank(moving, widths)
    evaluation = evaluation_of(controller, moving, config or EvaluateConfig(), str(plant))
    if out is None:
        return evaluation.summary()
    metadata = {"controller": str(controller), "kind": kind_of(controller), "plant": str(plant),
             "randomization": None if widths is None else widths.model_dump(mode="json")}  # fmt: skip
    return write_evaluation(evaluation, out, metadata, overwrite)


def kind_of(controller: Path) -> str:
    """``single``, ``grid`` or ``gaits``."""
    kind: str = artifacts.load_description(controller, "controller")["controller"]
    return kind


def evaluation_of(
    controller: Path, plant: str | EvaluationTarget, config: EvaluateConfig, named: str | None = None
) -> Evaluation:
    """A controller's experiments on a plant, not yet written."""
    moving = find_plant(plant) if isinstance(plant, str) else plant
    holding = load_controller(controller)
    check_limits(holding.limits, Limits(*moving.limits), controller, named or plant)
    return _evaluate(holding, moving, config)


def check_limits(asked: Limits, taken: Limits, controller: Path, plant: str | EvaluationTarget) -> None:
    """Raise PlantError where a controller commands more than a plant takes."""
    for low, high in (("angle_min", "angle_max"), ("velocity_min", "velocity_max")):
        ours, theirs = ((getattr(limits, low), getattr(limits, high)) for limits in (asked, taken))
        tolerance = 1e-3 * (theirs[1] - theirs[0])
        if ours[0] < theirs[0] - tolerance or ours[1] > theirs[1] + tolerance:
            quantity = low.removesuffix("_min")
            raise PlantError(
                f"{controller}: commands a {quantity} of {ours[0]:.3g} .. {ours[1]:.3g}; {plant} takes "
                f"{theirs[0]:.3g} .. {theirs[1]:.3g}; train it in a surrogate of this plant"
            )
