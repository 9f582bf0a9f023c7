"""Table I: how far a surrogate's predictions are from unseen logs, in physical units and on the scaled series.

The paper does not say how its DTW is normalised, so four definitions stand side by side, each along the best path
inside a Sakoe-Chiba band of 1 s (100 samples), with n the samples of a series and k >= n the steps of its path:
`dtw_raw` = sqrt(sum d^2), which grows with n; `dtw_path` = sqrt(sum d^2) / k; `dtw_rms` = sqrt(sum d^2 / n);
`dtw_mae` = sum |d| / n along the path that makes that sum least.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from dtaidistance import dtw
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.core.quantities import Log
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.predict import channels_of, predict
from softfin.surrogate.paper.scaling import Scaling
from softfin.surrogate.paper.surrogate import ANGLE, Surrogate
from softfin.surrogate.store import AnySurrogate
from softfin.surrogate.streaming.follow import follow, follow_force
from softfin.surrogate.streaming.force import Motion
from softfin.surrogate.streaming.member import parameters
from softfin.surrogate.streaming.streaming import StreamingSurrogate

SKIPPED = 100
"""Rows at the beginning of a log that are not scored: as many as PosNet's and ForceNet's first window."""

DTW_BAND = 100
"""Half-width of the band [samples]: a stretch of more than a second is no longer the same motion."""

Scores = dict[str, float]
Series = Float[np.ndarray, "samples channels"]


def series_scores(predicted: Series, measured: Series) -> Scores:
    """RMSE, MAE and DTW, each the mean over the channels."""
    error = predicted.astype(np.float64) - measured
    warped = [dtw_scores(p, m) for p, m in zip(predicted.T, measured.T, strict=True)]
    return {
        "rmse": float(np.mean(np.sqrt(np.mean(error**2, axis=0)))),
        "mae": float(np.mean(np.abs(error))),
        **_mean(warped),
    }


def dtw_scores(predicted: Float[np.ndarray, "samples"], measured: Float[np.ndarray, "samples"]) -> Scores:
    """Of one channel, in its unit: all are proportional to a change of scale."""
    a, b = (np.ascontiguousarray(series, np.float64) for series in (predicted, measured))
    path, distance = dtw.warping_path_fast(a, b, window=DTW_BAND, include_distance=True)
    absolute = dtw.distance_fast(a, b, window=DTW_BAND, inner_dist="euclidean")
    return {
        "dtw_raw": float(distance),
        "dtw_path": float(distance / len(path)),
        "dtw_rms": float(distance / np.sqrt(len(a))),
        "dtw_mae": float(absolute / len(a)),
    }


def table_one(surrogate: AnySurrogate, logs: Sequence[Log]) -> dict[str, Any]:
    """Table I, averaged over the test logs; rows behind the first `SKIPPED` count.

    Keys: ``posnet``, ``forcenet_measured`` (given the measured angle) and ``forcenet_free_running`` (behind PosNet,
    commands in, forces out), each with ``window``, ``parameters``, ``physical`` (rad or N) and ``scaled`` scores. Of a
    streaming surrogate ``drive``, ``force_measured`` and ``force_free_running``, with no window; all members together.
    """
    if isinstance(surrogate, StreamingSurrogate):
        # It has no scaling of its own; so, as in `softfin compare`, the range of what was measured.
        said, scaling = _streaming_said(surrogate, logs), measured_scaling(logs)
    else:
        said, scaling = [_paper_said(surrogate, log) for log in logs], surrogate.scaling
    rows: dict[str, list[dict[str, Scores]]] = {name: [] for name in said[0]}
    for log, each in zip(logs, said, strict=True):
        measured = channels_of(log)
        for name, (channels, series) in each.items():
            actual = np.stack([measured[channel][-len(series) :] for channel in channels], axis=1)
            rows[name].append(_both(scaling, channels, series, actual))
    return {
        name: {
            **_facts(surrogate, name),
            **{unit: _mean([row[unit] for row in each]) for unit in ("physical", "scaled")},
        }
        for name, each in rows.items()
    }


def measured_scaling(logs: Sequence[Log]) -> Scaling:
    """Of angle and forces in test logs; raises LogError where one of them never changes."""
    columns = [channels_of(log) for log in logs]
    joined = {name: np.concatenate([each[name] for each in columns]) for name in (ANGLE, *FORCES)}
    for name, values in joined.items():
        if not values.max() > values.min():
            raise LogError(f"column {name} is {values[0]:g} in every row of the test logs: nothing can be scored on "
                           "it; give test logs in which it changes, or none")  # fmt: skip
    return Scaling.fit(joined)


Said = dict[str, tuple[tuple[str, ...], Series]]
"""Of one log, by row of the table: channels, and what was predicted of the last rows of the log."""


def _paper_said(surrogate: Surrogate, log: Log) -> Said:
    free, given = predict(surrogate, log, "free-running"), predict(surrogate, log, "measured")
    return {
        "posnet": ((ANGLE,), free.angle[:, None]),
        "forcenet_measured": (FORCES, given.force),
        "forcenet_free_running": (FORCES, free.force),
    }


def _streaming_said(surrogate: StreamingSurrogate, logs: Sequence[Log]) -> list[Said]:
    members = surrogate.members
    measured = [Motion(*np.tile(np.stack([r.angle, r.velocity])[:, None], (surrogate.size, 1))) for _, r in logs]
    given = follow_force(members.force, measured)
    return [
        {
            "drive": ((ANGLE,), free.angle.mean(axis=0)[SKIPPED:, None]),
            "force_measured": (FORCES, np.asarray(said.force).mean(axis=0)[SKIPPED:]),
            "force_free_running": (FORCES, free.force.mean(axis=0)[SKIPPED:]),
        }
        for free, said in zip(follow(members, logs), given, strict=True)
    ]


def _facts(surrogate: AnySurrogate, name: str) -> dict[str, Any]:
    if isinstance(surrogate, StreamingSurrogate):
        net = surrogate.members.drive if name == "drive" else surrogate.members.force
        return {"window": None, "parameters": parameters(net)}
    network = surrogate.posnet if name == "posnet" else surrogate.forcenet
    return {"window": surrogate.window, "parameters": network.config.parameters()}


def _both(scaling: Scaling, names: Sequence[str], predicted: Series, measured: Series) -> dict[str, Scores]:
    def scaled(series: Series) -> Series:
        return np.stack([scaling.scaled(n, c) for n, c in zip(names, series.T, strict=True)], axis=1)

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
