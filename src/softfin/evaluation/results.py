"""Types of the rows in ``evaluation.json``, ``baselines.json`` and ``results.json``.

The rows are plain dictionaries because they are written and read as JSON. docs/files.md explains
the keys.
"""

from typing import NotRequired, TypedDict

from softfin.core.json_object import JsonObject
from softfin.core.power import MeanPower


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
    shaft_travel_rad_s: float
    power: NotRequired[dict[str, MeanPower]]
    """Mean mechanical power on the fin and electrical power of its motor, if known."""


class ReferenceScores(MeanScores):
    """Scores for one reference."""

    reference_n: list[float]
    tracked_reference_n: NotRequired[list[float]]
    still: bool
    surrogate: NotRequired[JsonObject]
    """Uncertainty estimated by a surrogate."""
    commanded: NotRequired[JsonObject]
    """Commands of a baseline: a sine or the actions of a gait."""


class MovingRow(MeanScores):
    """Scores for one moving reference."""

    described: str
    duration_s: float
    settles: bool | None
    """Whether every step settles; None without steps."""
    longest_settling_s: float | None
    settling_s: list[list[float | None]]
    """Settling times by repetition and by reference step [s]; None for never."""


class RangeErrors(TypedDict):
    """Errors (x, y) at many references with one repetition [N]."""

    references_n: list[list[float]]
    errors_n: list[list[float]]
    mean_n: list[float]
    p95_n: list[float]
    worst_n: list[float]


class FeedbackScores(TypedDict):
    """Estimates of feedback over the windows after the first 6 s of the first repetition."""

    half_width_n: list[float]
    """Mean half-width of the 90% interval of the true mean force (x, y) [N]."""
    coverage: float | None
    """Fraction of the windows in which the true mean force is within the interval; None if the
    plant does not compute it."""
    level: float
    """Largest `Estimate.level`."""


class EvaluationSummary(TypedDict):
    """``evaluation.json``, and each baseline of ``baselines.json``."""

    kind: str
    format: int
    conditions: JsonObject
    """Duration, repetitions and rates, plus entries added by the caller, e.g. controller and
    plant."""
    references: list[ReferenceScores]
    mean: MeanScores
    warning: str | None
    moving: NotRequired[list[MovingRow]]
    random: NotRequired[RangeErrors]
    feedback: NotRequired[FeedbackScores]
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
    with_feedback: dict[str, EvaluationSummary] | None
    """Evaluations with force feedback."""
    in_surrogate: dict[str, EvaluationSummary] | None
    """Evaluations in the surrogate that was used for training."""
    stages: list[StageRow]
    wall_s: dict[str, float]
    peak_memory_gib: float
    configuration: JsonObject
    provenance: JsonObject
