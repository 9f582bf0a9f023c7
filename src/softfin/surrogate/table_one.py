"""Scores the predictions of surrogates for logs, as in Table I of the paper.

The paper does not state how it normalises the distance of dynamic time warping (DTW). softfin
divides the minimum sum of |difference| over all warping paths within a Sakoe-Chiba band of 1 s by
the number of samples, so the result is at most the mean absolute error. DTW hides lags, so it is
always reported together with the RMSE.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from dtaidistance import dtw
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AnyArray, Log
from softfin.surrogate.channels import ANGLE, FORCES, NetPrediction, ranges, to_columns
from softfin.surrogate.protocol import SurrogatePlant

DTW_BAND = 100
"""Half-width of the Sakoe-Chiba band [samples]; motions that are more than 1 s apart are treated as
different."""

Samples = Float[np.ndarray, "samples"]


def rmse(predicted: AnyArray, measured: AnyArray) -> float:
    """Return the root mean square error."""
    return float(np.sqrt(np.mean(np.square(np.asarray(predicted, np.float64) - measured))))


def mae(predicted: AnyArray, measured: AnyArray) -> float:
    """Return the mean absolute error."""
    return float(np.mean(np.abs(np.asarray(predicted, np.float64) - measured)))


def dtw_mae(predicted: Samples, measured: Samples) -> float:
    """Return the mean absolute difference of one channel after dynamic time warping."""
    # The C code reads the buffers directly. "euclidean" sums |a - b|; the default would sum
    # (a - b)^2 and take the root.
    first = np.ascontiguousarray(predicted, np.float64)
    second = np.ascontiguousarray(measured, np.float64)
    distance = dtw.distance_fast(first, second, window=DTW_BAND, inner_dist="euclidean")
    return float(distance / len(predicted))


TABLE_I_SCORES: Mapping[str, Callable[[Samples, Samples], float]] = {
    "rmse": rmse,
    "mae": mae,
    "dtw_mae": dtw_mae,
}


def table_one(surrogate: SurrogatePlant, logs: Sequence[Log]) -> JsonObject:
    """Return Table I: title, unit, window, number of parameters and scores of each network,
    averaged over logs and channels.

    ``physical`` scores are in rad or N. ``scaled`` scores are multiplied by the scale factors of
    the surrogate, or divided by the measured range if there are none.
    """
    scales = {}
    for name, span in measured_ranges(logs).items():
        scales[name] = 1 / span
    if surrogate.scaling is not None:
        scales = {name: channel.scale for name, channel in surrogate.scaling.channels.items()}
    table: JsonObject = {}
    for name, prediction in surrogate.predictions(logs).items():
        scores = _table_scores(prediction, logs)
        scaled = scores * [scales[channel] for channel in prediction.channels]
        table[name] = {
            "title": prediction.title,
            "unit": "rad" if ANGLE in prediction.channels else "N",
            "window": prediction.window,
            "parameters": prediction.parameters,
        }
        for unit, values in (("physical", scores), ("scaled", scaled)):
            means = values.mean(axis=(0, 2)).tolist()
            table[name][unit] = dict(zip(TABLE_I_SCORES, means, strict=True))
    return table


def _table_scores(
    prediction: NetPrediction, logs: Sequence[Log]
) -> Float[np.ndarray, "logs scores channels"]:
    channels = prediction.channels
    scores = np.empty((len(logs), len(TABLE_I_SCORES), len(channels)))
    for i, (predicted, log) in enumerate(zip(prediction.series, logs, strict=True)):
        measured = to_columns([log])
        for j, score in enumerate(TABLE_I_SCORES.values()):
            for k, channel in enumerate(channels):
                # Rows before the first complete window have no prediction.
                actual = measured[channel][-len(predicted) :]
                scores[i, j, k] = score(predicted[:, k], actual)
    return scores


def measured_ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Return the range of the measured values of each channel over test logs.

    Raises:
        LogError: If a channel never changes.
    """
    spans = {}
    for name, (low, high) in ranges(logs, (ANGLE, *FORCES)).items():
        spans[name] = high - low
        if not high > low:
            raise LogError(
                f"test logs: column {name} is {low:g} in every row, so its predictions cannot be "
                "scored; use test logs in which it changes, or no test logs"
            )
    return spans
