"""Evaluate a controller on a plant: experiment, scores over seeds, ``evaluation.json`` and figures as one folder."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.control.controller import Controller
from softfin.control.disturbance_observer import DisturbanceObserver, DisturbanceObserverConfig
from softfin.control.references import resolve_reference
from softfin.core.action_clock import ACTION_RATE_HZ, WINDOW
from softfin.core.choices import MovingReference
from softfin.core.configuration import Configuration
from softfin.core.quantities import AXES, RATE_HZ
from softfin.core.randomness import key_of
from softfin.core.statistics import CONFIDENCE, interval
from softfin.evaluation.doubt import Doubt, doubt
from softfin.evaluation.drawn import MOST, Drawn, hold_drawn
from softfin.evaluation.experiment import MIN_SECONDS, Recording, Subject, alike, check_finite, first_of, run
from softfin.evaluation.figures import experiments_figure, moving_figure
from softfin.evaluation.forceplane import ErrorMap, error_map_figure, map_range
from softfin.evaluation.moving import Moving, follow, planned
from softfin.evaluation.paper import REFERENCES
from softfin.evaluation.scores import STILL_RAD_S, Scores, score
from softfin.storage import artifact as artifacts
from softfin.storage.figures import render
from softfin.task.signals import Recorded

Reference = tuple[pydantic.FiniteFloat, pydantic.FiniteFloat]


class EvaluateConfig(Configuration):
    """Which experiments a controller is scored by."""

    references: tuple[Reference, ...] = pydantic.Field(default=REFERENCES, min_length=1)
    """Reference forces (x, y) [N]; the paper's six."""
    seconds: int = pydantic.Field(default=30, ge=MIN_SECONDS)
    """Length of each experiment [s], whole, from rest; the paper's 30. The first 2 s only fill the first window."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Repetitions, each with its own randomness of the plant; intervals need at least 2."""
    seed: int = pydantic.Field(default=0, ge=0)
    """The run's seed, from which those of the repetitions are drawn."""
    moving: tuple[MovingReference, ...] = ()
    """References that move, too: `softfin.evaluation.moving.SIGNALS`, laid out in the controller's range."""
    recorded: Recorded | None = None
    """Another that moves, as read from a file; its last force is held as long as the one before."""
    strict: bool = False
    """Whether a reference that the fin cannot make is refused; else the nearest one that it can make is held."""
    trim: DisturbanceObserverConfig | None = None
    """A slow outer loop about the controller that cancels the steady-state force error."""
    error_map: int | None = pydantic.Field(default=None, ge=2, le=50)
    """References along each side of a lattice over the controller's range, for a map of the error; None draws none."""
    random: int | None = pydantic.Field(default=None, ge=1, le=MOST)
    """References drawn at random over all that the controller was trained for and the fin can make; None: none."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Scores of all experiments and the recording of the first repetition."""

    config: EvaluateConfig
    scores: Scores
    repetitions: int
    """Independent ones: a plant without randomness does the same at every seed, so it is run as often as it differs."""
    recording: Recording
    """Of the first seed alone: fields ``(references, 1, ticks)``, as NumPy arrays."""
    doubt: Doubt | None = None
    """What a surrogate knows of its own errors; None of a plant that is none, or knows nothing."""
    warnings: tuple[str, ...] = ()
    """References that were replaced by the nearest that the fin can make, for a time or altogether."""
    moving: tuple[Moving, ...] = ()
    """Experiments whose reference moves, those of one length together."""
    error_map: ErrorMap | None = None
    """Errors over the controller's range."""
    drawn: Drawn | None = None
    """Errors over random references."""

    def summary(self) -> dict[str, Any]:
        """Conditions, scores by reference and their mean; the first part of what `write_evaluation` writes."""
        still = np.all(self.scores.late_travel < STILL_RAD_S, axis=1).tolist()
        return {
            "conditions": {
                "duration_s": self.config.seconds,
                "seeds": self.repetitions,
                "seeds_asked": self.config.seeds,
                "seed": self.config.seed,
                "window_samples": WINDOW,
                "rate_hz": RATE_HZ,
                "action_rate_hz": ACTION_RATE_HZ,
                "start": "at rest at angle 0",
                "confidence": CONFIDENCE,
                "still_below_rad_s": STILL_RAD_S,
            },
            "references": [
                {
                    "reference_n": list(reference),
                    "held_n": [round(float(x), 4) for x in self.recording.reference[i]],
                    **_row(Scores(*(field[i] for field in self.scores))),
                    "still": still[i],
                    **({} if self.doubt is None else {"surrogate": self.doubt.to_dict(i)}),
                }
                for i, reference in enumerate(self.config.references)
            ],
            "mean": _row(Scores(*(field.mean(axis=0) for field in self.scores))),
            "warning": "; ".join(self._warnings()) or None,
            **({"moving": [row for moving in self.moving for row in moving.to_dict()]} if self.moving else {}),
            **({} if self.error_map is None else {"error_map": self.error_map.to_dict()}),
            **({} if self.drawn is None else {"random": self.drawn.to_dict()}),
        }

    def _warnings(self) -> list[str]:
        doubted = None if self.doubt is None else self.doubt.warning()
        return [*self.warnings, *([] if doubted is None else [doubted])]


def evaluate(controller: Controller, plant: Subject, config: EvaluateConfig) -> Evaluation:
    """Run and score all experiments; errors are those against the reference that is held.

    Raises CoverageError for a reference that the controller was not trained for, or with `config.strict` for one that
    the fin cannot make.
    """
    admissions = [resolve_reference(controller, reference, config.strict) for reference in config.references]
    held = np.array([reference for reference, _ in admissions], np.float32)
    warnings = tuple(said for _, said in admissions if said is not None)
    if config.trim is not None:
        controller = DisturbanceObserver(controller, config.trim)
    plans = planned(controller, config.moving, config.recorded, config.strict)
    warnings += tuple(said for plan in plans for said in plan.warnings)
    keys = jnp.stack([key_of(config.seed, f"evaluate/{repetition}") for repetition in range(config.seeds)])
    recording = run(controller, plant, held, config.seconds, keys)
    check_finite(recording)
    kept = first_of(recording)
    scores, repetitions = score(recording), config.seeds
    if alike(recording):
        scores, repetitions = Scores(*(field[:, :1] for field in scores)), 1
    points, count = config.error_map, config.random
    return Evaluation(
        config,
        scores,
        repetitions,
        kept,
        doubt(plant, kept),
        warnings,
        moving=tuple(follow(controller, plant, plan, keys) for plan in plans),
        error_map=None if points is None else map_range(controller, plant, points, config.seconds, keys[0]),
        drawn=None if count is None else hold_drawn(controller, plant, count, config.seed, config.seconds, keys[0]),
    )


def write_evaluation(
    evaluation: Evaluation, out: Path, metadata: Mapping[str, Any] | None = None, overwrite: bool = False
) -> dict[str, Any]:
    """Write ``evaluation.json`` and figures, each as ``.svg`` and ``.png``, as one folder; returns the JSON.

    ======================== ========================================================================================
    ``conditions``           duration_s, seeds, seed, window_samples, rate_hz, action_rate_hz, start, confidence, ...;
                             and the caller's `metadata`, such as the controller and the plant
    ``references``           a list, one entry a reference force: ``reference_n`` [x, y] [N]; ``held_n``, the nearest to
                             it that the fin can make, which the scores are against; ``x`` and ``y``, each with
                             ``error_n``, ``std_n``, ``raw_std_n`` [N], which are means over the seeds, and the 95%
                             intervals of these means, ``error_interval_n``, ... as [low, high], null for a single seed;
                             ``command_travel_rad_s``, ``shaft_travel_rad_s``: path of target angle and shaft a second;
                             ``still``: whether the shaft rests in the second half of the experiment, at every seed
    ``surrogate``            in each of these, where the plant is a surrogate that knows its errors: ``beyond_data``,
                             the share of samples beyond its data, ``furthest``, the greatest distance (1: their edge),
                             ``half_width_x_n``, ``y``: of the 90% interval of its mean force [N]; ``warning`` in words
    ``mean``                 the same over all references, the intervals again over the seeds
    ``moving``               where asked for, a list, one entry a signal: ``kind``, ``signal``; ``x`` and ``y`` with
                             ``error_n`` against the reference's mean over the same window and ``instantaneous_error_n``
                             against the reference itself; ``steps``, of each step the responses of all seeds: rise,
                             overshoot, settling, null where it never comes there; ``longest_settling_s``;
                             ``replaced_s``: for how long another force is held, as the fin cannot make what is asked
    ``error_map``            where asked for: ``low_n``, ``high_n``, ``points`` and the error of every reference
    ``random``               where asked for: ``count`` references drawn over cells and reach, at one seed; of each axis
                             ``mean_n``, ``p95_n``, ``worst_n`` of their errors, and ``worst_reference_n``
    ``configuration``        of this evaluation; of a recorded reference its ``rows`` and ``seconds``
    ``provenance``           versions, git commit, time
    ======================== ========================================================================================
    """
    summary = evaluation.summary()
    summary["conditions"] |= dict(metadata or {})
    summary["configuration"] = _described(evaluation.config)
    summary["provenance"] = artifacts.provenance(seed=evaluation.config.seed)

    def write(folder: Path) -> None:
        (folder / "evaluation.json").write_text(artifacts.dump_json(summary))
        for name, figure in _figures(evaluation).items():
            for kind in ("svg", "png"):
                (folder / f"{name}.{kind}").write_bytes(render(figure, kind))

    artifacts.write_folder(out, write, overwrite)
    return summary


def _described(config: EvaluateConfig) -> dict[str, Any]:
    recorded = config.recorded
    known = None if recorded is None else {"rows": len(recorded.time_s), "seconds": recorded.seconds}
    return {**config.model_dump(mode="json", exclude={"recorded"}), "recorded": known}


def _figures(evaluation: Evaluation) -> dict[str, Figure]:
    figures = {"experiments": experiments_figure(evaluation.recording)}
    if evaluation.moving:
        figures["moving"] = moving_figure(evaluation.moving)
    if evaluation.error_map is not None:
        figures["error_map"] = error_map_figure(evaluation.error_map)
    return figures


def _row(scores: Scores) -> dict[str, Any]:
    """Of one reference, or the mean of all: fields ``(seeds, 2)`` and ``(seeds,)``."""
    axes = {
        axis: {
            **_mean("error", scores.error[:, i]),
            **_mean("std", scores.std[:, i]),
            **_mean("raw_std", scores.raw_std[:, i]),
        }
        for i, axis in enumerate(AXES)
    }
    return {
        **axes,
        "command_travel_rad_s": float(scores.command_travel.mean()),
        "shaft_travel_rad_s": float(scores.shaft_travel.mean()),
    }


def _mean(name: str, values: Float[np.ndarray, "seeds"]) -> dict[str, Any]:
    return {f"{name}_n": float(values.mean()), f"{name}_interval_n": interval(values)}
