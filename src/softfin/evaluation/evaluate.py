"""Evaluate a controller on a plant: experiment, scores over seeds, ``evaluation.json`` and figures as one folder."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Float

from softfin import artifacts
from softfin.configuration import Configuration
from softfin.control.controller import Controller
from softfin.errors import PlantError
from softfin.evaluation.doubt import Doubt, doubt
from softfin.evaluation.experiment import Recording, run
from softfin.evaluation.figures import experiments_figure
from softfin.evaluation.paper import REFERENCES
from softfin.evaluation.scores import STILL_RAD_S, Scores, score
from softfin.evaluation.statistics import CONFIDENCE, interval
from softfin.evaluation.style import render
from softfin.plant import ACTION_RATE_HZ, WINDOW, Plant
from softfin.quantities import AXES, RATE_HZ
from softfin.randomness import key_of

Reference = tuple[pydantic.FiniteFloat, pydantic.FiniteFloat]


class EvaluateConfig(Configuration):
    """Which experiments a controller is scored by."""

    references: tuple[Reference, ...] = pydantic.Field(default=REFERENCES, min_length=1)
    """Reference forces (x, y) [N]; the paper's six."""
    seconds: int = pydantic.Field(default=30, ge=3)
    """Length of each experiment [s], whole, from rest; the paper's 30. The first 2 s only fill the first window."""
    seeds: int = pydantic.Field(default=5, ge=1)
    """Repetitions, each with its own randomness of the plant; intervals need at least 2."""
    seed: int = pydantic.Field(default=0, ge=0)
    """The run's seed, from which those of the repetitions are drawn."""


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
                    **_row(Scores(*(field[i] for field in self.scores))),
                    "still": still[i],
                    **({} if self.doubt is None else {"surrogate": self.doubt.described(i)}),
                }
                for i, reference in enumerate(self.config.references)
            ],
            "mean": _row(Scores(*(field.mean(axis=0) for field in self.scores))),
            "warning": None if self.doubt is None else self.doubt.warning(),
        }


def evaluate(controller: Controller, plant: Plant, config: EvaluateConfig) -> Evaluation:
    """Run and score all experiments; raises CoverageError for a reference that the controller was not trained for."""
    for reference in config.references:
        controller.check(reference)
    keys = jnp.stack([key_of(config.seed, f"evaluate/{repetition}") for repetition in range(config.seeds)])
    recording = run(controller, plant, np.asarray(config.references, np.float32), config.seconds, keys)
    _check_finite(recording)
    first = jax.tree.map(lambda x: np.asarray(x[:, :1]), (recording.command, recording.reading))
    scores, repetitions = score(recording), config.seeds
    if _alike(recording):
        scores, repetitions = Scores(*(field[:, :1] for field in scores)), 1
    kept = Recording(np.asarray(recording.reference), *first)
    return Evaluation(config, scores, repetitions, kept, doubt(plant, kept))


def _alike(recording: Recording) -> bool:
    """Whether all seeds did the same."""
    force = np.asarray(recording.reading.force)
    return bool((force == force[:, :1]).all())


def write_evaluation(evaluation: Evaluation, out: Path, facts: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Write ``evaluation.json`` and ``experiments.svg``, ``.png`` as one folder; returns the content of the JSON.

    ======================== ========================================================================================
    ``conditions``           duration_s, seeds, seed, window_samples, rate_hz, action_rate_hz, start, confidence, ...;
                             and the caller's `facts`, such as the controller and the plant
    ``references``           a list, one entry a reference force: ``reference_n`` [x, y] [N]; ``x`` and ``y``, each with
                             ``error_n``, ``std_n``, ``raw_std_n`` [N], which are means over the seeds, and the 95%
                             intervals of these means, ``error_interval_n``, ... as [low, high], null for a single seed;
                             ``command_travel_rad_s``, ``shaft_travel_rad_s``: path of target angle and shaft a second;
                             ``still``: whether the shaft rests in the second half of the experiment, at every seed
    ``surrogate``            in each of these, where the plant is a surrogate that knows its errors: ``beyond_data``,
                             the share of samples beyond its data, ``furthest``, the greatest distance (1: their edge),
                             ``half_width_x_n``, ``y``: of the 90% interval of its mean force [N]; ``warning`` in words
    ``mean``                 the same over all references, the intervals again over the seeds
    ``provenance``           versions, git commit, time
    ======================== ========================================================================================
    """
    summary = evaluation.summary()
    summary["conditions"] |= dict(facts or {})
    summary["provenance"] = artifacts.provenance(seed=evaluation.config.seed)

    def write(folder: Path) -> None:
        (folder / "evaluation.json").write_text(artifacts.dump_json(summary))
        figure = experiments_figure(evaluation.recording)
        for kind in ("svg", "png"):
            (folder / f"experiments.{kind}").write_bytes(render(figure, kind))

    artifacts.check_vacant(out, overwrite=True)
    artifacts.write_folder(out, write)
    return summary


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


def _check_finite(recording: Recording) -> None:
    """Raise PlantError where a reading is no number; the scores of such an experiment would mean nothing."""
    bad = np.argwhere(~np.isfinite(recording.reading.force).all(axis=-1) | ~np.isfinite(recording.reading.angle))
    if bad.size:
        index, seed, tick = bad[0]
        command = [float(part[index, seed, tick]) for part in recording.command]
        raise PlantError(
            f"reference ({recording.reference[index][0]:g}, {recording.reference[index][1]:g}) N, seed {seed}, "
            f"{(tick + 1) / RATE_HZ:.2f} s: force or angle is no finite number after the command (angle "
            f"{command[0]:.3f} rad, velocity {command[1]:.3f} rad/s); every reading of a plant must be finite"
        )
