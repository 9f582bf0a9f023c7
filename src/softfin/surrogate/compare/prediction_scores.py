"""Scores of free-running predictions: measured and predicted stretches of logs in, Table I's columns and more out.

Errors are pooled over all rows of all stretches. The mean force is that over 200 samples, what controllers are judged
by: every run of 200 within a stretch counts, so horizons shorter than 2 s have none.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import WINDOW
from softfin.core.errors import LogError
from softfin.core.quantities import AXES, AnyArray, Log, Reading
from softfin.evaluation.scores import moving_average
from softfin.surrogate.compare.metrics import dtw_scores

UNITS = {"angle": "rad", "force_x": "n", "force_y": "n"}

Means = Float[np.ndarray, "stretches windows *axes"]
"""Of the force over 200 samples, (x, y) [N]."""


class Judgement(NamedTuple):
    """Of one surrogate at one horizon."""

    scores: dict[str, float]
    """By name with unit; those of the mean force and of its interval only where there are such."""
    mean_errors: Means | None
    """Predicted minus measured."""
    half_widths: Means | None
    """Of the stated interval of each."""


def ranges(logs: Sequence[Log]) -> dict[str, float]:
    """Greatest minus least measured value of each channel over all logs: what the scaled scores are divided by."""
    readings = [log.reading for log in logs]
    columns = _channels(np.concatenate([r.angle for r in readings]), np.concatenate([r.force for r in readings]))
    spans = {name: float(values.max()) - float(values.min()) for name, values in columns.items()}
    for name, span in spans.items():
        if not span > 0:
            raise LogError(f"test logs: {name} is the same in every row, so no prediction of it can be judged")
    return spans


HalfWidth: TypeAlias = Callable[[Float[np.ndarray, "members stretches windows 2"]], AnyArray]
"""The members' means of 200 samples in; out the half-width of the stated interval of each of their means."""


def judge(
    measured: Log,
    predicted: Reading,
    spans: Mapping[str, float],
    members: Float[np.ndarray, "members stretches ticks 2"] | None = None,
    half_width: HalfWidth | None = None,
) -> Judgement:
    """Score stretches; fields ``(stretches, ticks)``; `members` and `half_width` of an ensemble that states intervals.

    ============================== ==================================================================================
    ``angle_rmse_rad``, ``mae``    over all rows
    ``force_x_rmse_n``, ``y``      over all rows; ``force_mae_n`` over both axes
    ``angle_r2``, ``force_x_r2``   1 - square error / square deviation of what is measured; not finite without any
    ``angle_dtw_KIND_rad``         mean over stretches; KIND as in `softfin.surrogate.compare.metrics`
    ``force_dtw_KIND_n``           the same, mean over both axes
    ``..._dtw_KIND_scaled``        of the series divided by `spans`
    ``mean_force_x_mae_n``, ``y``  mean absolute error of the mean force; ``mean_force_mae_n`` of both axes
    ``mean_force_p95_n``           95th percentile of that absolute error, both axes; ``worst``: the greatest
    ``coverage``, ``half_width_n`` share of these errors inside the stated 90% interval, its mean half-width;
                                   ``coverage_x``, ``y``
    ============================== ==================================================================================
    """
    actual = _channels(measured.reading.angle, measured.reading.force)
    said = _channels(predicted.angle, predicted.force)
    error = {name: said[name] - actual[name] for name in UNITS}
    rmse = {name: float(np.sqrt(np.mean(each**2))) for name, each in error.items()}
    scores = {f"{name}_rmse_{UNITS[name]}": value for name, value in rmse.items()}
    scores["angle_mae_rad"] = float(np.mean(np.abs(error["angle"])))
    scores["force_mae_n"] = float(np.mean([np.abs(error[f"force_{axis}"]) for axis in AXES]))
    with np.errstate(divide="ignore", invalid="ignore"):  # of what never changes there is none
        scores |= {f"{name}_r2": float(1 - np.square(value) / np.var(actual[name])) for name, value in rmse.items()}
    scores |= _warped(actual, said, spans)
    if measured.reading.angle.shape[1] < WINDOW:
        return Judgement(scores, None, None)
    errors = moving_average(np.asarray(predicted.force)) - moving_average(np.asarray(measured.reading.force))
    scores |= _of_means(errors)
    if half_width is None or members is None:
        return Judgement(scores, errors, None)
    half_widths = np.asarray(half_width(np.stack([moving_average(force) for force in members])))
    scores |= {"coverage": coverage(half_widths, errors), "half_width_n": float(np.mean(half_widths))}
    scores |= {f"coverage_{axis}": coverage(half_widths[..., i], errors[..., i]) for i, axis in enumerate(AXES)}
    return Judgement(scores, errors, half_widths)


def coverage(half_widths: Means, errors: Means) -> float:
    """Share of the errors that lie within the half-widths that were stated for them."""
    return float(np.mean(np.abs(errors) <= half_widths))


def _of_means(errors: Means) -> dict[str, float]:
    size = np.abs(errors)
    each = {f"mean_force_{axis}_mae_n": float(size[..., index].mean()) for index, axis in enumerate(AXES)}
    return {
        **each,
        "mean_force_mae_n": float(size.mean()),
        "mean_force_p95_n": float(np.quantile(size, 0.95)),
        "mean_force_worst_n": float(size.max()),
    }


Channels = dict[str, np.ndarray]


def _channels(angle: AnyArray, force: AnyArray) -> Channels:
    """By name, in float64."""
    forces = {f"force_{axis}": force[..., index] for index, axis in enumerate(AXES)}
    return {name: np.asarray(values, np.float64) for name, values in {"angle": angle, **forces}.items()}


def _warped(actual: Channels, said: Channels, spans: Mapping[str, float]) -> dict[str, float]:
    scores = {}
    for quantity, names in {"angle": ["angle"], "force": [f"force_{axis}" for axis in AXES]}.items():
        rows = {name: [dtw_scores(*pair) for pair in zip(said[name], actual[name], strict=True)] for name in names}
        for kind in rows[names[0]][0]:
            each = np.array([np.mean([row[kind] for row in rows[name]]) for name in names])
            scores[f"{quantity}_{kind}_{UNITS[names[0]]}"] = float(each.mean())
            # A distance is proportional to the scale of its series.
            scores[f"{quantity}_{kind}_scaled"] = float((each / [spans[name] for name in names]).mean())
    return scores
