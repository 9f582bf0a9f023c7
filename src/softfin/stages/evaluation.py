"""Stages that evaluate a moving fin with a controller (paper Sec. IV-B)."""

from pathlib import Path

from softfin.control.store import load_controller
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.quantities import Limits
from softfin.evaluation.evaluate import (
    EvaluateConfig,
    score_controller,
    write_evaluation,
)
from softfin.evaluation.experiment import EvaluationTarget
from softfin.evaluation.results import EvaluationSummary
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
