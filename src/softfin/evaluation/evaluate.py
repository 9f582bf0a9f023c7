"""Evaluates a controller on a plant and writes a folder with ``evaluation.json`` and figures."""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import cast

import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float, Key

from softfin.control.controller import Controller, controller_clock
from softfin.control.family import Family, load_family
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.references import (
    controller_cells,
    default_references,
    reachable_set,
    resolve_reference,
)
from softfin.control.store import load_controller
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
from softfin.evaluation.moving_references import MovingScores, plan_moving
from softfin.evaluation.range_errors import MAX_RANDOM, random_errors, summarize
from softfin.evaluation.results import EvaluationSummary, RangeErrors, ReferenceScores
from softfin.evaluation.scores import (
    STILL_RAD_S,
    Scores,
    data_distance,
    feedback_scores,
    judged_force,
    mean_scores,
    outside_fraction,
    outside_warning,
    score,
    scores_together,
    settled_band,
)
from softfin.gaits.reachable import Reachable
from softfin.storage import artifact as artifacts
from softfin.task.signals import Recorded


class EvaluateConfig(Configuration):
    """Configuration of the experiments for scoring a controller."""

    references: tuple[tuple[pydantic.FiniteFloat, pydantic.FiniteFloat], ...] = pydantic.Field(
        default=()
    )
    """Reference forces (x, y) [N]; by default the paper's six references, or the same pattern
    scaled to the reach of the fin."""
    seconds: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Duration of each experiment from rest [s], an integer; 30 in the paper. Means start when the
    first window is full."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Number of repetitions with different plant seeds; confidence intervals need at least 3."""
    seed: int = pydantic.Field(default=0, ge=0)
    """Seed of the run, from which the seeds of the repetitions and all other randomness are
    derived."""
    moving: bool = False
    """Whether to also evaluate reference steps within the range of the controller."""
    recorded: Recorded | None = None
    """Additional moving reference from a file; the last force is held for as long as the previous
    one."""
    strict: bool = False
    """Whether unreachable references are errors; otherwise, the nearest reachable force is
    tracked."""
    feedback: FeedbackConfig | None = None
    """Feedback, which corrects the reference for changes of the fin; None for no feedback."""
    random: int | None = pydantic.Field(default=None, ge=1, le=MAX_RANDOM)
    """Number of random references, drawn from the reachable forces for which the controller was
    trained; None for no random references."""

    def keys(self) -> Key[Array, "seeds"]:
        """Return the keys with which the plant is initialized in each repetition."""
        return jnp.stack(
            [named_key(self.seed, f"evaluate/{repetition}") for repetition in range(self.seeds)]
        )


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Scores of all experiments and the recording of the first repetition."""

    config: EvaluateConfig
    scores: Scores
    repetitions: int
    """Number of independent repetitions; 1 for a deterministic plant, because it ignores the
    seed."""
    recording: ExperimentRecording
    """Recording of the first repetition: fields ``(references, 1, ticks)``, as NumPy arrays."""
    distance: Float[np.ndarray, "references ticks"] | None = None
    """Distance from the training data of a surrogate; None for other plants."""
    warnings: tuple[str, ...] = ()
    """Warnings about references that were replaced by the nearest reachable force."""
    moving: tuple[MovingScores, ...] = ()
    """Experiments with moving references, grouped by length."""
    random: RangeErrors | None = None
    """Errors over random references."""
    reachable: Reachable | None = None
    """Reachable forces of the fin, if the controller file contains them."""

    def summary(self) -> EvaluationSummary:
        """Return the conditions, the scores of each reference and their mean, as written by
        `write_evaluation`."""
        uncertain = None if self.distance is None else outside_warning(self.distance)
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
                "judged_by": judged_force(self.recording),
                "confidence": CONFIDENCE,
                "still_below_rad_s": STILL_RAD_S,
                "reach_n": None if self.reachable is None else self.reachable.reach_n,
                "settled_n": settled_band(self.reachable),
            },
            "references": [
                self._reference_scores(index) for index in range(len(self.config.references))
            ],
            "mean": mean_scores(self.scores),
            "warning": "; ".join(filter(None, (*self.warnings, uncertain))) or None,
        }
        if self.recording.estimate is not None:
            summary["feedback"] = feedback_scores(self.recording)
        if self.moving:
            summary["moving"] = [row for moving in self.moving for row in moving.rows()]
        if self.random is not None:
            summary["random"] = self.random
        return summary

    def _reference_scores(self, index: int) -> ReferenceScores:
        tracked = self.recording.reference[index]
        row: JsonObject = {
            **mean_scores(self.scores, index),
            "reference_n": list(self.config.references[index]),
            "tracked_reference_n": [round(float(force), 4) for force in tracked],
            "still": bool((self.scores.late_travel[index] < STILL_RAD_S).all()),
        }
        if self.distance is not None:
            row["surrogate"] = {
                "out_of_distribution_fraction": outside_fraction(self.distance[index]),
                "furthest": float(self.distance[index].max()),
            }
        return cast(ReferenceScores, row)


def score_controller(
    controller: Controller,
    plant: EvaluationTarget,
    config: EvaluateConfig,
    family: Family | None = None,
) -> Evaluation:
    """Run and score all experiments; errors are relative to the tracked reference. Feedback uses
    `family`, if it is given.

    Raises CoverageError if the controller was not trained for a reference or, with `config.strict`,
    if a reference is unreachable. Raises ConfigurationError if the experiments are too short for
    the clock of the controller.
    """
    reachable = reachable_set(controller)
    config = _with_references(config, controller)
    references = []
    warnings = []
    for reference in config.references:
        resolved, warning = resolve_reference(controller, reference, config.strict)
        references.append(resolved)
        if warning is not None:
            warnings.append(warning)
    tracked = np.array(references, np.float32)
    # The feedback is added only after the references are resolved, because it must reach the
    # resolved references.
    if config.feedback is not None:
        controller = Feedback(controller, config.feedback, family)
    plans = list(plan_moving(controller, config.moving, config.recorded, config.strict))
    keys = config.keys()
    seconds = config.seconds
    clock = controller_clock(controller)
    if seconds < min_seconds(clock):
        raise ConfigurationError(
            f"seconds = {seconds}: too short for the clock of this controller ({clock}); use at "
            f"least {min_seconds(clock)}"
        )
    experiments = [(tracked, seconds), *((plan.tracked, plan.seconds) for plan in plans)]
    constant, *moving = run_together(controller, plant, experiments, keys)
    evaluation = score_experiments(constant, plant, config)
    for plan in plans:
        warnings += plan.warnings
    random = None
    if config.random is not None:
        random = random_errors(controller, plant, config.random, config.seed, seconds, keys[0])
    return dataclasses.replace(
        evaluation,
        reachable=reachable,
        warnings=tuple(warnings),
        moving=tuple(plan.score(recording) for plan, recording in zip(plans, moving, strict=True)),
        random=random,
    )


def _with_references(config: EvaluateConfig, controller: Controller) -> EvaluateConfig:
    """Return the configuration with the default references of a controller if it has none."""
    if config.references:
        return config
    defaults = default_references(reachable_set(controller), controller_cells(controller))
    return config.model_copy(update={"references": defaults})


def score_experiments(
    recording: ExperimentRecording, plant: EvaluationTarget, config: EvaluateConfig
) -> Evaluation:
    """Run and score experiments at the configured references, for any source of commands."""
    recording = independent(recording)
    first = recording.first()
    repetitions = recording.reading.angle.shape[1]
    return Evaluation(config, score(recording), repetitions, first, data_distance(plant, first))


def check_limits(asked: Limits, taken: Limits, controller: Path, named: str) -> None:
    """Raise PlantError if the commands of a controller can exceed the limits of the plant."""
    for i, quantity in ((0, "angle"), (2, "velocity")):
        ours = asked[i : i + 2]
        theirs = taken[i : i + 2]
        tolerance = 1e-3 * (theirs[1] - theirs[0])
        if ours[0] < theirs[0] - tolerance or ours[1] > theirs[1] + tolerance:
            raise PlantError(
                f"{controller}: commands a {quantity} of {ours[0]:.3g} .. {ours[1]:.3g}, but "
                f"{named} accepts {theirs[0]:.3g} .. {theirs[1]:.3g}; train the controller in a "
                "surrogate of this plant"
            )


def together(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Combine evaluations into one: each becomes a repetition, recordings and plans are taken from
    the first evaluation, and random references are pooled.

    Raises ConfigurationError if the controllers tracked different forces.
    """
    first = evaluations[0]
    for each in evaluations[1:]:
        if not _track_the_same(first, each):
            raise ConfigurationError(
                "controllers: their ranges differ, so they track different forces; evaluate them "
                "separately, or set --reference to forces that all of them can track"
            )
    moving = []
    for same in zip(*(evaluation.moving for evaluation in evaluations), strict=True):
        scores = scores_together([part.scores for part in same])
        by_signal = zip(*(part.settling for part in same), strict=True)
        settling = list(map(np.concatenate, by_signal))
        moving.append(same[0]._replace(scores=scores, settling=settling))
    random = None
    pooled = [evaluation.random for evaluation in evaluations if evaluation.random is not None]
    if pooled:
        random = summarize(
            np.concatenate([part["references_n"] for part in pooled]),
            np.concatenate([part["errors_n"] for part in pooled]),
        )
    distances = [each.distance for each in evaluations if each.distance is not None]
    warnings = dict.fromkeys(chain(*(evaluation.warnings for evaluation in evaluations)))
    return dataclasses.replace(
        first,
        scores=scores_together([evaluation.scores for evaluation in evaluations]),
        repetitions=len(evaluations),
        distance=np.concatenate(distances, axis=1) if distances else None,
        warnings=tuple(warnings),
        moving=tuple(moving),
        random=random,
    )


def _track_the_same(one: Evaluation, other: Evaluation) -> bool:
    """Return whether two evaluations have the same tracked references, including every tick of
    moving references."""
    tracked = [[each.recording.reference] for each in (one, other)]
    for forces, evaluation in zip(tracked, (one, other), strict=True):
        forces += [moving.plan.tracked for moving in evaluation.moving]
    return all(map(np.array_equal, *tracked))


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
    """Evaluate the controllers in one or more folders; with `out`, write the evaluation.

    Several controllers, for example from different training seeds, are treated as repetitions of
    one evaluation with consecutive seeds.
    """
    controllers = [load_controller(path) for path in paths]
    controller = controllers[0]
    first = f"{controller.kind}, {controller_clock(controller)}"
    for path, other in zip(paths, controllers, strict=True):
        check_limits(other.limits, target.limits, path, str(metadata["plant"]))
        own = f"{other.kind}, {controller_clock(other)}"
        if own != first:
            raise ConfigurationError(
                f"{path}: {own}, but {paths[0]} is {first}; evaluate them separately"
            )
    config = _with_references(config, controller)
    evaluations = []
    for index, (path, other) in enumerate(zip(paths, controllers, strict=True)):
        seeded = config.model_copy(update={"seed": config.seed + index})
        family = None if config.feedback is None else load_family(path, other)
        evaluations.append(score_controller(other, target, seeded, family))
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
    """Write a folder with ``evaluation.json`` and the figures, and return the content of the JSON
    file.

    The JSON file contains `Evaluation.summary`, with `metadata` (e.g. controller and plant) added
    to ``conditions``, the ``configuration`` (without a recorded reference) and the ``provenance``;
    docs/files.md explains the keys.
    """
    # Imported here because importing Matplotlib takes a second and is needed only for drawing.
    from softfin.evaluation.figures import experiments_figure, fin_figure, moving_figure
    from softfin.storage.figures import save_figure

    summary = evaluation.summary()
    config = evaluation.config
    summary["conditions"] |= dict(metadata or {})
    summary["configuration"] = config.model_dump(mode="json", exclude={"recorded"})
    summary["provenance"] = artifacts.provenance(seed=config.seed)

    def write(folder: Path) -> None:
        artifacts.write_description(folder, "evaluation", summary)
        save_figure(experiments_figure(evaluation.recording), folder / "experiments.png")
        save_figure(fin_figure(evaluation.recording), folder / "fin.png")
        for moving in evaluation.moving:
            save_figure(moving_figure(moving), folder / f"{moving.plan.name}.png")

    artifacts.write_folder(out, write, overwrite)
    return summary
