"""Table I: how far a surrogate's predictions are from unseen logs, in physical units and on the scaled series.

The paper does not say how its DTW is normalised, so three definitions stand side by side, each along the best path
inside a Sakoe-Chiba band of 1 s (100 samples): `dtw_raw` = sqrt(sum d^2), `dtw_rms` = sqrt(sum d^2 / n),
`dtw_mae` = sum |d| / n, with n the number of samples.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from dtaidistance import dtw
from jaxtyping import Float

from softfin.quantities import Log
from softfin.surrogate.forcenet import FORCES
from softfin.surrogate.predict import channels_of, predict
from softfin.surrogate.surrogate import ANGLE, Surrogate

DTW_BAND = 100
"""Half-width of the band [samples]: a stretch of more than a second is no longer the same motion."""

Scores = dict[str, float]
Series = Float[np.ndarray, "samples channels"]


def series_scores(predicted: Series, measured: Series) -> Scores:
    """RMSE, MAE and DTW, each the mean over the channels."""
    error = predicted.astype(np.float64) - measured
    squared = [_dtw(p, m, "squared euclidean") for p, m in zip(predicted.T, measured.T, strict=True)]
    absolute = [_dtw(p, m, "euclidean") for p, m in zip(predicted.T, measured.T, strict=True)]
    n = len(error)
    return {
        "rmse": float(np.mean(np.sqrt(np.mean(error**2, axis=0)))),
        "mae": float(np.mean(np.abs(error))),
        "dtw_raw": float(np.mean(squared)),
        "dtw_rms": float(np.mean(squared) / np.sqrt(n)),
        "dtw_mae": float(np.mean(absolute) / n),
    }


def _dtw(a: Float[np.ndarray, "samples"], b: Float[np.ndarray, "samples"], inner: str) -> float:
    first, second = (np.ascontiguousarray(x, np.float64) for x in (a, b))
    return float(dtw.distance_fast(first, second, window=DTW_BAND, inner_dist=inner))


def table_one(surrogate: Surrogate, logs: Sequence[Log]) -> dict[str, Any]:
    """Table I, averaged over the test logs.

    Keys: ``posnet``, ``forcenet_measured`` (given the measured angle) and ``forcenet_free_running`` (behind PosNet,
    commands in, forces out), each with ``window``, ``parameters``, ``physical`` (rad or N) and ``scaled`` scores.
    """
    rows: dict[str, list[dict[str, Scores]]] = {"posnet": [], "forcenet_measured": [], "forcenet_free_running": []}
    for log in logs:
        measured = {name: values[surrogate.window :, None] for name, values in channels_of(log).items()}
        force = np.concatenate([measured[name] for name in FORCES], axis=1)
        free, given = predict(surrogate, log, "free-running"), predict(surrogate, log, "measured")
        rows["posnet"].append(_both(surrogate, (ANGLE,), free.angle[:, None], measured[ANGLE]))
        rows["forcenet_measured"].append(_both(surrogate, FORCES, given.force, force))
        rows["forcenet_free_running"].append(_both(surrogate, FORCES, free.force, force))
    return {
        name: {
            "window": surrogate.window,
            "parameters": (surrogate.posnet if name == "posnet" else surrogate.forcenet).config.parameters(),
            **{unit: _mean([row[unit] for row in each]) for unit in ("physical", "scaled")},
        }
        for name, each in rows.items()
    }


def _both(surrogate: Surrogate, names: Sequence[str], predicted: Series, measured: Series) -> dict[str, Scores]:
    def scaled(series: Series) -> Series:
        return np.stack([surrogate.scaling.scaled(n, c) for n, c in zip(names, series.T, strict=True)], axis=1)

    return {
        "physical": series_scores(predicted, measured),
        "scaled": series_scores(scaled(predicted), scaled(measured)),
    }


def _mean(scores: Sequence[Mapping[str, float]]) -> Scores:
    return {name: float(np.mean([score[name] for score in scores])) for name in scores[0]}


PAPER_TABLE_I = {
    "posnet": {"window": 100, "parameters": 113_601, "rmse": 0.03, "mae": 0.002, "dtw": 0.002},
    "forcenet": {"window": 100, "parameters": 129_794, "rmse": 0.2, "mae": 0.04, "dtw": 0.03},
}
"""The paper's Table I; units and the normalisation of DTW are not stated there."""
