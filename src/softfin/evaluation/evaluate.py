"""Evaluate a controller on a plant: experiment, scores over seeds, ``evaluation.json`` and figures
as one folder."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Key

from softfin.control.controller import Controller
from softfin.control.disturbance_observer import DisturbanceObserver, DisturbanceObserverConfig
from softfin.control.references import resolve_reference
from softfin.core.action_clock import ACTION_RATE_HZ, WINDOW
from softfin.core.choices import MovingReference
from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ
from softfin.core.randomness import named_key
from softfin.core.window import CONFIDENCE
from softfin.evaluation.experiment import (
    MIN_SECONDS,
    EvaluationTarget,
    ExperimentRecording,
    independent,
    run_together,
)
from softfin.evaluation.figures import error_map_figure, experiments_figure, moving_figure
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
)
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage import artifact as artifacts
from softfin.storage.figures import save_figure
from softfin.task.signals import Recorded


class ExperimentsConfig(Configuration):
    """Experiments at constant references."""

    references: tuple[tuple[pydantic.FiniteFloat, pydantic.FiniteFloat], ...] = pydantic.Field(
        default=PAPER_REFERENCES, min_length=1
    )
    """Reference forces (x, y) [N]; the paper's six."""
    seconds: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Length of each experiment [s], whole, from rest; the paper's 30. The first 2 s only fill the
    first window."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Repetitions, each with its own randomness of the plant; intervals need at least 3."""
    seed: int = pydantic.Field(default=0, ge=0)
    """The run's seed, from which those of the repetitions, and everything else random, are
    derived."""

    def keys(self) -> Key[Array, "seeds"]:
        """Return the keys with which the repetitions start a plant."""
        return jnp.stack(
            [named_key(self.seed, f"evaluate/{repetition}") for repetition in range(self.seeds)]
        )


class EvaluateConfig(ExperimentsConfig):
    """Experiments by which a controller is scored."""

    moving: tuple[MovingReference, ...] = ()
    """Kinds of moving references: `evaluation.moving_references.SIGNALS`, placed in the
    controller's range."""
    recorded: Recorded | None = None
    """Another moving reference, as read from a file; its last force is held as long as the previous
    one."""
    strict: bool = False
    """Whether a reference that the fin cannot make is refused; otherwise the nearest one that it
    can make is tracked."""
    trim: DisturbanceObserverConfig | None = None
    """Force feedback around the controller, which subtracts its estimated steady-state error; None
    for no feedback."""
    error_map: int | None = pydantic.Field(default=None, ge=2, le=50)
    """References along each side of a lattice over the controller's range, for a map of the error;
    None draws none."""
    random: int | None = pydantic.Field(default=None, ge=1, le=MAX_RANDOM)
    """Number of references drawn at random over the forces for which the controller was trained and
    that the fin can make, or None."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Scores of all experiments and the recording of the first repetition."""

    config: EvaluateConfig
    scores: Scores
    repetitions: int
    """Number of independent repetitions: 1 for a plant without randomness, which is the same at
    every seed."""
    recording: ExperimentRecording
    """Recording of the first seed only: fields ``(references, 1, ticks)``, as NumPy arrays."""
    uncertainty: SurrogateUncertainty | None = None
    """Uncertainty that a surrogate estimates; None for other plants."""
    warnings: tuple[str, ...] = ()
    """Sentences about references that were replaced by the nearest ones that the fin can make."""
    moving: tuple[MovingScores, ...] = ()
    """Experiments with moving references, grouped by length."""
    error_map: ErrorMap | None = None
    """Errors over the controller's range."""
    random: RandomErrors | None = None
    """Errors over random references."""

    def summary(self) -> EvaluationSummary:
        """Return conditions, scores by reference and their mean; the first part of what
        `write_evaluation` writes."""
        uncertain = None if self.uncertainty is None else self.uncertainty.warning()
        summary = cast(EvaluationSummary, artifacts.head("evaluation"))
        summary |= {
            "conditions": {
                "duration_s": self.config.seconds,
                "seeds": self.repetitions,
                "seeds_asked": self.config.seeds,
                "seed": self.config.seed,
                "window_samples": WINDOW,
                "rate_hz": RATE_HZ,
                "action_rate_hz": ACTION_RATE_HZ,
                "start": "at rest at angle 0",
                "judged_by": judged_force(self.recording),
                "confidence": CONFIDENCE,
                "still_below_rad_s": STILL_RAD_S,
            },
            "references": [
                self._reference_scores(index) for index in range(len(self.config.references))
            ],
            "mean": mean_scores(jax.tree.map(lambda field: field.mean(axis=0), self.scores)),
            "warning": "; ".join(filter(None, (*self.warnings, uncertain))) or None,
        }
        if self.moving:
            summary["moving"] = [row for moving in self.moving for row in moving.rows]
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
    """Scores of one reference, or the mean of all: fields ``(seeds, 2)`` and ``(seeds,)``."""
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
    """Run and score all experiments; errors are those against the tracked reference.

    Raises CoverageError for a reference for which the controller was not trained, or with
    `config.strict` for one that the fin cannot make.
    """
    resolved = [
        resolve_reference(controller, reference, config.strict) for reference in config.references
    ]
    tracked = np.array([reference for reference, _ in resolved], np.float32)
    if config.trim is not None:
        controller = DisturbanceObserver(controller, config.trim)
    plans = plan_moving(controller, config.moving, config.recorded, config.strict)
    keys = config.keys()
    seconds = config.seconds
    experiments = [(tracked, seconds), *((plan.tracked, plan.seconds) for plan in plans)]
    constant, *moving = run_together(controller, plant, experiments, keys)
    evaluation = score_experiments(constant, plant, config)
    warnings = [warning for _, warning in resolved if warning is not None]
    for plan in plans:
        warnings += plan.warnings
    error_map = random = None
    if config.error_map is not None:
        error_map = map_errors(controller, plant, config.error_map, seconds, keys[0])
    if config.random is not None:
        random = random_errors(controller, plant, config.random, config.seed, seconds, keys[0])
    return dataclasses.replace(
        evaluation,
        warnings=tuple(warnings),
        moving=tuple(plan.score(recording) for plan, recording in zip(plans, moving, strict=True)),
        error_map=error_map,
        random=random,
    )


def score_experiments(
    recording: ExperimentRecording, plant: EvaluationTarget, config: EvaluateConfig
) -> Evaluation:
    """Score experiments of the configuration's references, no matter what commanded the plant."""
    recording = independent(recording)
    first = recording.first()
    repetitions = recording.reading.angle.shape[1]
    return Evaluation(config, score(recording), repetitions, first, score_uncertainty(plant, first))


def together(each: Sequence[Evaluation]) -> Evaluation:
    """Return one evaluation whose repetitions are the given ones, each averaged over its own; the
    recordings are those of the first."""
    means = [jax.tree.map(lambda field: field.mean(axis=1), e.scores) for e in each]
    scores: Scores = jax.tree.map(lambda *fields: np.stack(fields, axis=1), *means)
    estimates = [e.uncertainty for e in each if e.uncertainty is not None]
    uncertainty = None
    if estimates:
        outside, furthest, half_width = map(np.stack, zip(*estimates, strict=True))
        uncertainty = SurrogateUncertainty(
            outside.mean(axis=0), furthest.max(axis=0), half_width.mean(axis=0)
        )
    warnings = tuple(dict.fromkeys(warning for e in each for warning in e.warnings))
    moving = tuple(map(moving_together, zip(*(e.moving for e in each), strict=True)))
    return Evaluation(
        each[0].config, scores, len(each), each[0].recording, uncertainty, warnings, moving
    )


def write_evaluation(
    evaluation: Evaluation,
    out: Path,
    metadata: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> EvaluationSummary:
    """Write ``evaluation.json`` and figures, each as ``.svg`` and ``.png``, as one folder; returns
    the JSON.

    It holds `Evaluation.summary`, with the caller's `metadata` in ``conditions``, such as the
    controller and the plant; ``configuration``, of a recorded reference its ``rows`` and
    ``seconds``; ``provenance``. docs/files.md has the keys.
    """
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
        save_figure(experiments_figure(evaluation.recording), folder, "experiments")
        if evaluation.moving:
            save_figure(moving_figure(evaluation.moving), folder, "moving")
        if evaluation.error_map is not None:
            save_figure(error_map_figure(evaluation.error_map), folder, "error_map")

    artifacts.write_folder(out, write, overwrite)
    return summary
