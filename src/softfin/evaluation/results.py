"""Types of the rows in ``evaluation.json``, ``baselines.json`` and ``results.json``.

They are plain dictionaries, because they are written and read as JSON. docs/files.md explains the
keys.
"""

from typing import NotRequired, TypedDict

import numpy as np
from jaxtyping import Float

from softfin.core.json_object import JsonObject
from softfin.core.window import interval


class AxisScores(TypedDict):
    """Scores on one axis [N]: mean over the repetitions, its 95% interval, and all values."""

    error_n: float
    error_interval_n: list[float] | None
    error_seeds_n: list[float]
    std_n: float
    std_interval_n: list[float] | None
    std_seeds_n: list[float]
    raw_std_n: float
    raw_std_interval_n: list[float] | None
    raw_std_seeds_n: list[float]
    reading_error_n: NotRequired[float]
    reading_error_interval_n: NotRequired[list[float] | None]
    reading_error_seeds_n: NotRequired[list[float]]


class MeanScores(TypedDict):
    """Scores for one reference, or their mean over all references."""

    x: AxisScores
    y: AxisScores
    command_travel_rad_s: float
    shaft_travel_rad_s: float


class UncertaintyRow(TypedDict):
    """Uncertainty estimated by a surrogate for one reference."""

    out_of_distribution_fraction: float
    furthest: float
    half_width_x_n: float
    half_width_y_n: float


class ReferenceScores(MeanScores):
    """Scores for one reference."""

    reference_n: list[float]
    tracked_reference_n: NotRequired[list[float]]
    still: bool
    surrogate: NotRequired[UncertaintyRow]
    commanded: NotRequired[JsonObject]
    """Commands of a baseline: a sine or the actions of a gait."""


class StepResponse(TypedDict):
    """Response of the moving average to one step of the reference force."""

    at_s: float
    start_n: list[float]
    to_n: list[float]
    rise_x_s: float | None
    rise_y_s: float | None
    overshoot_x_percent: float | None
    overshoot_y_percent: float | None
    settling_s: float | None


class TrackingErrors(TypedDict):
    """Errors on one axis while the reference moves [N]."""

    error_n: float
    error_interval_n: list[float] | None
    error_seeds_n: list[float]
    instantaneous_error_n: float
    reading_error_n: NotRequired[float]
    reading_error_interval_n: NotRequired[list[float] | None]
    reading_error_seeds_n: NotRequired[list[float]]


class MovingRow(TypedDict):
    """Scores for one moving reference."""

    kind: str
    described: str
    signal: JsonObject
    """Configuration of the reference, without the rows of a recorded signal."""
    duration_s: float
    replaced_s: float
    x: TrackingErrors
    y: TrackingErrors
    settles: bool | None
    longest_settling_s: float | None
    steps: list[list[StepResponse]]
    """Responses by step of the reference and by repetition."""


class ErrorMapPoint(TypedDict):
    """Errors at one reference of an error map [N]."""

    reference_n: list[float]
    error_x_n: float
    error_y_n: float


class ErrorMapRows(TypedDict):
    """An error map [N]."""

    points: int
    low_n: list[float]
    high_n: list[float]
    seeds: int
    not_covered: int
    not_reachable: int
    references: list[ErrorMapPoint]
    mean_x_n: float
    mean_y_n: float
    worst_x_n: float
    worst_y_n: float


class RandomAxisErrors(TypedDict):
    """Errors on one axis over random references [N]."""

    mean_n: float
    p95_n: float
    worst_n: float
    worst_reference_n: list[float]


class RandomErrors(TypedDict):
    """Errors over random references."""

    count: int
    seeds: int
    x: RandomAxisErrors
    y: RandomAxisErrors


class EvaluationSummary(TypedDict):
    """``evaluation.json``, and each baseline of ``baselines.json``."""

    kind: str
    format: int
    conditions: JsonObject
    """Duration, repetitions and rates, plus entries by the caller, e.g. controller and plant."""
    references: list[ReferenceScores]
    mean: MeanScores
    warning: str | None
    moving: NotRequired[list[MovingRow]]
    error_map: NotRequired[ErrorMapRows]
    random: NotRequired[RandomErrors]
    configuration: NotRequired[JsonObject]
    provenance: NotRequired[JsonObject]


class StageRow(TypedDict):
    """One stage of a run; stages that an earlier run finished have no times."""

    stage: str
    what: str
    wall_s: float | None
    processor_s: float | None
    page: NotRequired[str]


class RunResults(TypedDict, total=False):
    """``results.json`` of a run; a report omits missing parts."""

    kind: str
    format: int
    title: str
    preset: str
    plant: str
    seed: int
    seeds: int
    surrogate: JsonObject | None
    """``{"scores": ...}`` from `table_one`; None if the run used an existing surrogate."""
    controllers: dict[str, EvaluationSummary]
    """Evaluation of each kind of controller (``gaits``, ``single``, ``grid``)."""
    trimmed: dict[str, EvaluationSummary] | None
    """Evaluations with force feedback."""
    in_surrogate: dict[str, EvaluationSummary] | None
    """Evaluations in the surrogate that was used for training."""
    stages: list[StageRow]
    wall_s: dict[str, float]
    peak_memory_gib: float
    configuration: JsonObject
    provenance: JsonObject


def score_keys(name: str, values: Float[np.ndarray, " repetitions"] | None) -> JsonObject:
    """Return the keys of one score on one axis [N]: mean, interval and values; empty without
    values."""
    if values is None:
        return {}
    return {
        f"{name}_n": float(values.mean()),
        f"{name}_interval_n": interval(values),
        f"{name}_seeds_n": values.tolist(),
    }
