"""Scores of predictions: Table I one log at a time, and those of free-running segments of several horizons.

The paper cites dynamic time warping (DTW) and does not say how it normalises the distance. Here it is `dtw_mae`, in the
unit of the series and no greater than their mean absolute error: the least sum of |difference| over all warping paths
inside a Sakoe-Chiba band of 1 s, divided by the number of samples (computed by dtaidistance). It forgives a lag, so it
never stands without RMSE.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from dtaidistance import dtw
from jaxtyping import Float

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError
from softfin.core.quantities import AXES, AnyArray, Log, Reading
from softfin.core.window import moving_average
from softfin.surrogate.channels import ANGLE, FORCES, columns_of, ranges
from softfin.surrogate.store import AnySurrogate

DTW_BAND = 100
"""Half-width of the band [samples]: a shift of more than a second is no longer the same motion."""

PAPER_TABLE_I = {
    "posnet": {"window": 100, "parameters": 113_601, "rmse": 0.03, "mae": 0.002, "dtw": 0.002},
    "forcenet": {"window": 100, "parameters": 129_794, "rmse": 0.2, "mae": 0.04, "dtw": 0.03},
}
"""The paper's Table I; units and the normalisation of DTW are not stated there."""

Samples = Float[np.ndarray, "samples"]

Means = Float[np.ndarray, "segments windows 2"]
"""Mean forces over the evaluation window, (x, y) [N]."""


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
    measured = [columns_of([log]) for log in logs]
    table = {}
    for name, (channels, series, window, parameters) in surrogate.predictions(logs).items():
        scores = np.array([
            [[score(x, actual[channel][-len(x) :]) for channel, x in zip(channels, predicted.T, strict=True)]
             for score in TABLE_I_SCORES.values()]
            for predicted, actual in zip(series, measured, strict=True)
        ])  # fmt: skip
        scaled = scores * [scales[channel] for channel in channels]
        means = {unit: each.mean(axis=(0, 2)).tolist() for unit, each in (("physical", scores), ("scaled", scaled))}
        rows = {unit: dict(zip(TABLE_I_SCORES, values, strict=True)) for unit, values in means.items()}
        table[name] = {"window": window, "parameters": parameters, **rows}
    return table


def measured_ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Greatest minus least measured value of each channel over test logs; raises LogError where one never changes."""
    spans = {}
    for name, (low, high) in ranges(logs, (ANGLE, *FORCES)).items():
        spans[name] = high - low
        if not high > low:
            raise LogError(
                f"test logs: column {name} is {low:g} in every row, so that no prediction of it can be "
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
    measured: Log, predicted: Reading, spans: Mapping[str, float], half_widths: Means | None = None
) -> HorizonScores:
    """Score segments, fields ``(segments, ticks)``, over `measured_ranges`; `half_widths` of stated intervals [N].

    Errors are pooled over all rows of all segments; horizons shorter than the evaluation window have no mean force.
    docs/files.md describes each score.
    """
    pairs = {"angle": (predicted.angle, measured.reading.angle)}
    pairs |= {f"force_{x}": (predicted.force[..., i], measured.reading.force[..., i]) for i, x in enumerate(AXES)}
    scores, distances = {}, []
    for (name, pair), span in zip(pairs.items(), spans.values(), strict=True):
        error, distance = rmse(*pair), np.mean([dtw_mae(*one) for one in zip(*pair, strict=True)])
        scores[f"{name}_rmse_{'rad' if name == 'angle' else 'n'}"] = error
        with np.errstate(divide="ignore", invalid="ignore"):  # a channel that never changes has none
            scores[f"{name}_r2"] = float(1 - np.square(error) / np.var(np.asarray(pair[1], np.float64)))
        distances.append([distance, distance / span])
    scores |= {"angle_mae_rad": mae(*pairs["angle"]), "force_mae_n": mae(predicted.force, measured.reading.force)}
    scores |= dict(zip(("angle_dtw_mae_rad", "angle_dtw_mae_scaled"), map(float, distances[0]), strict=True))
    force_distances = np.mean(distances[1:], axis=0).tolist()
    scores |= dict(zip(("force_dtw_mae_n", "force_dtw_mae_scaled"), force_distances, strict=True))
    if measured.reading.angle.shape[1] < WINDOW:
        return HorizonScores(scores, None, None)
    mean_errors = moving_average(np.asarray(predicted.force)) - moving_average(np.asarray(measured.reading.force))
    size = np.abs(mean_errors)
    scores |= {f"mean_force_{axis}_mae_n": float(size[..., i].mean()) for i, axis in enumerate(AXES)}
    scores |= {"mean_force_mae_n": float(size.mean()), "mean_force_p95_n": float(np.quantile(size, 0.95)),
               "mean_force_worst_n": float(size.max())}  # fmt: skip
    if half_widths is not None:
        inside = size <= half_widths
        scores |= {"coverage": float(inside.mean()), "half_width_n": float(half_widths.mean())}
        scores |= {f"coverage_{axis}": float(inside[..., i].mean()) for i, axis in enumerate(AXES)}
    return HorizonScores(scores, mean_errors, half_widths)
