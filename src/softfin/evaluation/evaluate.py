"""Evaluate a controller on a plant and write ``evaluation.json`` and figures as a folder."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Key

from softfin.control.controller import Controller, controller_clock
from softfin.control.disturbance_observer import DisturbanceObserver, DisturbanceObserverConfig
from softfin.control.references import (
    controller_cells,
    default_references,
    reachable_set,
    resolve_reference,
)
from softfin.control.store import load_controller
from softfin.core.choices import MovingReference
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ, Limits
from softfin.core.randomness import named_key
from softfin.core.window import CONFIDENCE
from softfin.evaluation.experiment import (
    MIN_SECONDS,
    EvaluationTarget,
    ExperimentRecording,
    independent,
    min_seconds,
    run_together,
)
from softfin.evaluation.moving_references import (
    MovingScores,
    moving_together,
    plan_moving,
)
from softfin.evaluation.range_errors import MAX_RANDOM, ErrorMap, map_errors, random_errors
from softfin.evaluation.results import (
    AxisScores,
    EvaluationSummary,
    MeanScores,
    RandomErrors,
    ReferenceScores,
    score_keys,
)
from softfin.evaluation.scores import (
    STILL_RAD_S,
    Scores,
    SurrogateUncertainty,
    judged_force,
    score,
    score_uncertainty,
    settled_band,
)
from softfin.gaits.reachable import Reachable
from softfin.storage import artifact as artifacts
from softfin.task.signals import Recorded


class EvaluateConfig(Configuration):
    """Configuration of the experiments by which a controller is scored."""

    references: tuple[tuple[pydantic.FiniteFloat, pydantic.FiniteFloat], ...] = pydantic.Field(
        default=()
    )
    """Reference forces (x, y) [N]; by default the paper's six, or for another fin the same pattern
    within its reach."""
    seconds: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Duration of each experiment from rest [s], an integer; 30 in the paper. Means begin once
    the first window is full."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Number of repetitions with different randomness of the plant; intervals need at least 3."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the run, from which the seeds of the repetitions and all other randomness derive."""
    moving: tuple[MovingReference, ...] = ()
    """Kinds of moving references (`evaluation.moving_references.SIGNALS`), scaled to the
    controller's range."""
    recorded: Recorded | None = None
    """Another moving reference, read from a file; its last force is held for as long as the
    previous one."""
    strict: bool = False
    """Whether unreachable references are errors; otherwise, the nearest reachable force is
    tracked."""
    trim: DisturbanceObserverConfig | None = None
    """Force feedback, which subtracts the controller's estimated steady-state error; None for no
    feedback."""
    error_map: int | None = pydantic.Field(default=None, ge=2, le=50)
    """Number of references along each side of the error map, a lattice over the controller's range;
    None for no map."""
    random: int | None = pydantic.Field(default=None, ge=1, le=MAX_RANDOM)
    """Number of random references, drawn from the reachable forces that the controller was trained
    for; None to draw none."""

    def keys(self) -> Key[Array, "seeds"]:
        """Return the keys of the repetitions, with which a plant is initialized."""
        return jnp.stack(
            [named_key(self.seed, f"evaluate/{repetition}") for repetition in range(self.seeds)]
        )


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Scores of all experiments, and the recording of the first repetition."""

    config: EvaluateConfig
    scores: Scores
    repetitions: int
    """Number of independent repetitions; 1 for a deterministic plant, which ignores the seed."""
    recording: ExperimentRecording
    """Recording of the first seed: fields ``(references, 1, ticks)``, as NumPy arrays."""
    uncertainty: SurrogateUncertainty | None = None
    """Uncertainty estimated by a surrogate; None for other plants."""
    warnings: tuple[str, ...] = ()
    """Warnings about references that were replaced by the nearest reachable forces."""
    moving: tuple[MovingScores, ...] = ()
    """Experiments with moving references, grouped by length."""
    error_map: ErrorMap | None = None
    """Errors over the controller's range."""
    random: RandomErrors | None = None
    """Errors over random references."""
    reachable: Reachable | None = None
    """Forces that the fin can produce, if the controller's file contains them."""

    def summary(self) -> EvaluationSummary:
        """Return the conditions, the scores by reference and their mean, as written by
        `write_evaluation`."""
        uncertain = None if self.uncertainty is None else self.uncertainty.warning()
        summary = cast(EvaluationSummary, artifacts.head("evaluation"))
        summary |= {
            "conditions": {
                "duration_s": self.config.seconds,
                "seeds": self.repetitions,
                "seeds_asked": self.config.seeds,
                "seed": self.config.seed,
                "window_samples": self.recording.clock.window_ticks,
                "rate_hz": RATE_HZ,
                "action_rate_hz": self.recording.clock.rate_hz,
                "start": "at rest",
                "judged_by": judged_force(self.recording),
                "confidence": CONFIDENCE,
                "still_below_rad_s": STILL_RAD_S,
                "reach_n": None if self.reachable is None else self.reachable.reach_n,
                "settled_n": settled_band(self.reachable),
            },
            "references": [
                self._reference_scores(index) for index in range(len(self.config.references))
            ],
            "mean": mean_scores(jax.tree.map(lambda field: field.mean(axis=0), self.scores)),
            "warning": "; ".join(filter(None, (*self.warnings, uncertain))) or None,
        }
        if self.moving:
            summary["moving"] = []
            for moving in self.moving:
                summary["moving"] += moving.rows
        if self.error_map is not None:
            summary["error_map"] = self.error_map.to_dict()
        if self.random is not None:
            summary["random"] = self.random
        return summary

    def _reference_scores(self, index: int) -> ReferenceScores:
        tracked = self.recording.reference[index]
        scores = mean_scores(jax.tree.map(lambda field: field[index], self.scores))
        row: ReferenceScores = {
            "reference_n": list(self.config.references[index]),
            "tracked_reference_n": [round(float(force), 4) for force in tracked],
            "x": scores["x"],
            "y": scores["y"],
            "command_travel_rad_s": scores["command_travel_rad_s"],
            "shaft_travel_rad_s": scores["shaft_travel_rad_s"],
            "still": bool((self.scores.late_travel[index] < STILL_RAD_S).all()),
        }
        if self.uncertainty is not None:
            row["surrogate"] = self.uncertainty.to_dict(index)
        return row


def mean_scores(scores: Scores) -> MeanScores:
    """Return scores of one reference, or means over all, for JSON; their fields are ``(seeds, 2)``
    and ``(seeds,)``."""
    return {
        "x": _axis_scores(scores, 0),
        "y": _axis_scores(scores, 1),
        "command_travel_rad_s": float(scores.command_travel.mean()),
        "shaft_travel_rad_s": float(scores.shaft_travel.mean()),
    }


def _axis_scores(scores: Scores, axis: int) -> AxisScores:
    row: JsonObject = {}
    for name in ("error", "std", "raw_std", "reading_error"):
        values = getattr(scores, name)
        row |= score_keys(name, None if values is None else values[:, axis])
    return cast(AxisScores, row)


def score_controller(
    controller: Controller, plant: EvaluationTarget, config: EvaluateConfig
) -> Evaluation:
    """Run and score all experiments; errors are relative to the tracked reference.

    Raises CoverageError for references for which the controller was not trained, and with
    `config.strict` also for unreachable references, and ConfigurationError if the experiments are
    too short for the controller's clock.
    """
    reachable = reachable_set(controller)
    if not config.references:
        defaults = default_references(reachable, controller_cells(controller))
        config = config.model_copy(update={"references": defaults})
    references = []
    warnings = []
    for reference in config.references:
        resolved, warning = resolve_reference(controller, reference, config.strict)
        references.append(resolved)
        if warning is not None:
            warnings.append(warning)
    tracked = np.array(references, np.float32)
    # Only after the references are resolved: these are what the feedback has to reach.
    if config.trim is not None:
        controller = DisturbanceObserver(controller, config.trim)
    plans = plan_moving(controller, config.moving, config.recorded, config.strict)
    keys = config.keys()
    seconds = config.seconds
    clock = controller_clock(controller)
    if seconds < min_seconds(clock):
        raise ConfigurationError(
            f"seconds = {seconds}: too short for this controller's clock ({clock}); use at least "
            f"{min_seconds(clock)}"
        )
    experiments = [(tracked, seconds), *((plan.tracked, plan.seconds) for plan in plans)]
    constant, *moving = run_together(controller, plant, experiments, keys)
    evaluation = score_experiments(constant, plant, config)
    for plan in plans:
        warnings += plan.warnings
    error_map = random = None
    if config.error_map is not None:
        error_map = map_errors(controller, plant, config.error_map, seconds, keys[0])
    if config.random is not None:
        random = random_errors(controller, plant, config.random, config.seed, seconds, keys[0])
    return dataclasses.replace(
        evaluation,
        reachable=reachable,
        warnings=tuple(warnings),
        moving=tuple(plan.score(recording) for plan, recording in zip(plans, moving, strict=True)),
        error_map=error_map,
        random=random,
    )


def score_experiments(
    recording: ExperimentRecording, plant: EvaluationTarget, config: EvaluateConfig
) -> Evaluation:
    """Score experiments at the configured references, regardless of the source of the commands."""
    recording = independent(recording)
    first = recording.first()
    repetitions = recording.reading.angle.shape[1]
    return Evaluation(config, score(recording), repetitions, first, score_uncertainty(plant, first))


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


def together(each: Sequence[Evaluation]) -> Evaluation:
    """Combine evaluations into one, in which each becomes a repetition, averaged over its own
    repetitions; recordings are those of the first."""
    means = []
    moving = []
    estimates = []
    warnings: dict[str, None] = {}
    for evaluation in each:
        # Average over its own repetitions first, so that all evaluations have equal weight.
        means.append(jax.tree.map(lambda field: field.mean(axis=1), evaluation.scores))
        moving.append(evaluation.moving)
        if evaluation.uncertainty is not None:
            estimates.append(evaluation.uncertainty)
        # The keys of a dictionary: each warning once, in order.
        warnings |= dict.fromkeys(evaluation.warnings)
    scores: Scores = jax.tree.map(lambda *fields: np.stack(fields, axis=1), *means)
    uncertainty = None
    if estimates:
        outside, furthest, half_width = map(np.stack, zip(*estimates, strict=True))
        uncertainty = SurrogateUncertainty(
            outside.mean(axis=0), furthest.max(axis=0), half_width.mean(axis=0)
        )
    return Evaluation(
        config=each[0].config,
        scores=scores,
        repetitions=len(each),
        recording=each[0].recording,
        uncertainty=uncertainty,
        reachable=each[0].reachable,
        warnings=tuple(warnings),
        moving=tuple(map(moving_together, zip(*moving, strict=True))),
    )


def evaluate_controllers(
    paths: Sequence[Path],
    target: EvaluationTarget,
    config: EvaluateConfig,
    out: Path | None,
    metadata: Mapping[str, object],
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> EvaluationSummary:
    """Evaluate the controllers in some folders; with `out`, write the evaluation.

    Several controllers, such as those trained from different seeds, are the repetitions of one
    evaluation; each has the next seed.
    """
    evaluations = []
    for index, path in enumerate(paths):
        controller = load_controller(path)
        check_limits(controller.limits, target.limits, path, str(metadata["plant"]))
        own = config.model_copy(update={"seed": config.seed + index})
        evaluations.append(score_controller(controller, target, own))
        progress("evaluate", (index + 1) / len(paths), str(path))
    evaluation = evaluations[0] if len(evaluations) == 1 else together(evaluations)
    conditions = {
        "controller": ", ".join(map(str, paths)),
        "kind": controller.kind,
        **metadata,
    }
    if out is None:
        summary = evaluation.summary()
        summary["conditions"] |= conditions
        return summary
    return write_evaluation(evaluation, out, conditions, overwrite)


def write_evaluation(
    evaluation: Evaluation,
    out: Path,
    metadata: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> EvaluationSummary:
    """Write a folder with ``evaluation.json`` and the figures; return the content of the JSON
    file.

    It contains `Evaluation.summary`, the caller's `metadata` (e.g. controller and plant) in
    ``conditions``, ``configuration`` (for a recorded reference, only ``rows`` and ``seconds``) and
    ``provenance``. docs/files.md explains the keys.
    """
    # Matplotlib, which takes a second, is only imported to draw.
    from softfin.evaluation.figures import (
        error_map_figure,
        experiments_figure,
        held_figure,
        moving_figure,
    )
    from softfin.storage.figures import save_figure

    summary = evaluation.summary()
    config = evaluation.config
    summary["conditions"] |= dict(metadata or {})
    recorded = config.recorded and {
        "rows": len(config.recorded.time_s),
        "seconds": config.recorded.seconds,
    }
    summary["configuration"] = config.model_dump(mode="json", exclude={"recorded"})
    summary["configuration"]["recorded"] = recorded
    summary["provenance"] = artifacts.provenance(seed=config.seed)

    def write(folder: Path) -> None:
        artifacts.write_description(folder, "evaluation", summary)
        save_figure(experiments_figure(evaluation.recording), folder / "experiments.png")
        held = held_figure(evaluation.recording, settled_band(evaluation.reachable))
        save_figure(held, folder / "held.png")
        if evaluation.moving:
            save_figure(moving_figure(evaluation.moving), folder / "moving.png")
        if evaluation.error_map is not None:
            save_figure(error_map_figure(evaluation.error_map), folder / "error_map.png")

    artifacts.write_folder(out, write, overwrite)
    return summary
