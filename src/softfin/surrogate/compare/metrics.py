"""Scores of predictions: Table I one log at a time, and those of free-running segments of several horizons.

The paper cites dynamic time warping (DTW) and does not say how it normalises the distance. Here it is `dtw_mae`, in the
unit of the series and no greater than their mean absolute error: the least sum of |difference| over all warping paths
inside a Sakoe-Chiba band of 1 s, divided by the number of samples (computed by dtaidistance). It forgives a lag, so it
never stands without RMSE.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from dtaidistance import dtw
from jaxtyping import Float

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError
from softfin.core.quantities import AXES, AnyArray, Log, Reading
from softfin.core.window import moving_average
from softfin.surrogate.channels import ANGLE, FORCES, NetPrediction, channels_of, joined_channels
from softfin.surrogate.store import AnySurrogate

DTW_BAND = 100
"""Half-width of the band [samples]: a shift of more than a second is no longer the same motion."""

PAPER_TABLE_I = {
    "posnet": {"window": 100, "parameters": 113_601, "rmse": 0.03, "mae": 0.002, "dtw": 0.002},
    "forcenet": {"window": 100, "parameters": 129_794, "rmse": 0.2, "mae": 0.04, "dtw": 0.03},
}
"""The paper's Table I; units and the normalisation of DTW are not stated there."""

Samples = Float[np.ndarray, "samples"]

Means = Float[np.ndarray, "segments windows *axes"]
"""Mean forces over the evaluation window, (x, y) [N]."""

HalfWidth: TypeAlias = Callable[[Float[np.ndarray, "members segments windows 2"]], AnyArray]
"""Takes the members' mean forces to the half-width of the stated interval of their mean."""


def rms(error: AnyArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(error, dtype=np.float64))))


def rmse(predicted: AnyArray, measured: AnyArray) -> float:
    """Root mean square error."""
    return rms(np.asarray(predicted, np.float64) - measured)


def mae(predicted: AnyArray, measured: AnyArray) -> float:
    """Mean absolute error."""
    return float(np.mean(np.abs(np.asarray(predicted, np.float64) - measured)))


def dtw_mae(predicted: Samples, measured: Samples) -> float:
    """Mean absolute difference of one channel after warping: see the module."""
    series = [np.ascontiguousarray(samples, np.float64) for samples in (predicted, measured)]
    return float(dtw.distance_fast(*series, window=DTW_BAND, inner_dist="euclidean") / len(predicted))


TABLE_I_SCORES: Mapping[str, Callable[[Samples, Samples], float]] = {"rmse": rmse, "mae": mae, "dtw_mae": dtw_mae}


def table_one(surrogate: AnySurrogate, logs: Sequence[Log]) -> dict[str, Any]:
    """Table I, averaged over the test logs.

    Rows are the nets that `predictions` of a surrogate name, each with ``window``, ``parameters``, ``physical`` (rad
    or N) and ``scaled`` scores, the means over its channels. Scaled scores are those times the surrogate's scaling, or
    over the range of what was measured: a score is proportional to the scale of its series.
    """
    if surrogate.scaling is None:
        scales = {name: 1 / span for name, span in measured_ranges(logs).items()}
    else:
        scales = {name: channel.scale for name, channel in surrogate.scaling.channels.items()}
    predictions = surrogate.predictions(logs)
    table = {}
    for name, first in predictions[0].items():
        scores = np.array([_channel_scores(log, each[name]) for log, each in zip(logs, predictions, strict=True)])
        units = {"physical": np.ones(len(first.channels)), "scaled": np.array([scales[c] for c in first.channels])}
        means = {unit: (scores * scale).mean(axis=(0, 2)).tolist() for unit, scale in units.items()}
        rows = {unit: dict(zip(TABLE_I_SCORES, values, strict=True)) for unit, values in means.items()}
        table[name] = {"window": first.window, "parameters": first.parameters, **rows}
    return table


def _channel_scores(log: Log, prediction: NetPrediction) -> list[list[float]]:
    """Each score of each channel."""
    measured, rows = channels_of(log), len(prediction.series)
    pairs = [
        (each, measured[name][-rows:]) for name, each in zip(prediction.channels, prediction.series.T, strict=True)
    ]
    return [[score(*pair) for pair in pairs] for score in TABLE_I_SCORES.values()]


def measured_ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Greatest minus least measured value of each channel over test logs; raises LogError where one never changes."""
    columns = joined_channels(logs)
    spans = {name: float(columns[name].max()) - float(columns[name].min()) for name in (ANGLE, *FORCES)}
    for name, span in spans.items():
        if not span > 0:
            raise LogError(
                f"test logs: column {name} is {columns[name][0]:g} in every row, so that no prediction of it can be "
                "scored; give test logs in which it changes, or none"
            )
    return spans


class HorizonScores(NamedTuple):
    """Scores of one surrogate at one horizon."""

    scores: dict[str, float]
    """Scores by name with unit; those of the mean force and of its interval only where there are such."""
    mean_errors: Means | None
    """Errors of the mean force, predicted minus measured."""
    half_widths: Means | None
    """Half-width of the stated interval of each."""


def score_segments(
    measured: Log,
    predicted: Reading,
    ranges: Mapping[str, float],
    members: Float[np.ndarray, "members segments ticks 2"] | None = None,
    half_width: HalfWidth | None = None,
) -> HorizonScores:
    """Score segments, fields ``(segments, ticks)``; `members` and `half_width` of an ensemble that states intervals.

    Errors are pooled over all rows of all segments; horizons shorter than the evaluation window have no mean force.
    docs/files.md describes each score.
    """
    pairs = {"angle": (predicted.angle, measured.reading.angle)}
    pairs |= {f"force_{x}": (predicted.force[..., i], measured.reading.force[..., i]) for i, x in enumerate(AXES)}
    units = {"angle": "rad", **{f"force_{axis}": "n" for axis in AXES}}
    errors = {name: rmse(*pair) for name, pair in pairs.items()}
    scores = {f"{name}_rmse_{units[name]}": error for name, error in errors.items()}
    scores |= {"angle_mae_rad": mae(*pairs["angle"]), "force_mae_n": mae(predicted.force, measured.reading.force)}
    with np.errstate(divide="ignore", invalid="ignore"):  # a channel that never changes has none
        variances = {name: np.var(np.asarray(actual, np.float64)) for name, (_, actual) in pairs.items()}
        scores |= {f"{name}_r2": float(1 - np.square(error) / variances[name]) for name, error in errors.items()}
    warped = {name: np.mean([dtw_mae(*one) for one in zip(*pair, strict=True)]) for name, pair in pairs.items()}
    scaled = {name: warped[name] / span for name, span in zip(pairs, ranges.values(), strict=True)}
    for quantity, unit in (("angle", "rad"), ("force", "n")):
        names = [name for name in pairs if name.startswith(quantity)]
        scores[f"{quantity}_dtw_mae_{unit}"] = float(np.mean([warped[name] for name in names]))
        scores[f"{quantity}_dtw_mae_scaled"] = float(np.mean([scaled[name] for name in names]))
    if measured.reading.angle.shape[1] < WINDOW:
        return HorizonScores(scores, None, None)
    mean_errors = moving_average(np.asarray(predicted.force)) - moving_average(np.asarray(measured.reading.force))
    size = np.abs(mean_errors)
    scores |= {f"mean_force_{axis}_mae_n": float(size[..., i].mean()) for i, axis in enumerate(AXES)}
    scores |= {"mean_force_mae_n": float(size.mean()), "mean_force_p95_n": float(np.quantile(size, 0.95)),
               "mean_force_worst_n": float(size.max())}  # fmt: skip
    if half_width is None or members is None:
        return HorizonScores(scores, mean_errors, None)
    half_widths = np.asarray(half_width(moving_average(members)))
    inside = size <= half_widths
    scores |= {"coverage": float(inside.mean()), "half_width_n": float(half_widths.mean())}
    scores |= {f"coverage_{axis}": float(inside[..., i].mean()) for i, axis in enumerate(AXES)}
    return HorizonScores(scores, mean_errors, half_widths)
