"""How well the logs determine each parameter, from the residuals and their slopes at the optimum.

Standard errors are the jackknife's over blocks of time, in the linear model about the optimum: each block is left out
once. Errors within a block may be correlated in any way, as those of a model always are; blocks are taken as
independent (Cameron and Miller 2015, J. Human Resources 50, 317, sec. VI.B). No standard error is less than that for
errors without correlation. A parameter that sits on an end of its range is taken as given there, and one without any
effect, such as a limit that is never met, is left out.
"""

from itertools import combinations
from typing import Any

import numpy as np

from softfin.tank.calibration.config import Parameter
from softfin.tank.calibration.search import DIFFERENCE, Linear

TRADING = 0.9
"""Correlation from which two parameters are said to trade against each other."""

VERDICTS = (("well", 0.1), ("roughly", 0.5), ("poorly", np.inf))
"""Verdict by the part of the uncertainty that is left: standard error over the deviation of the whole range."""

IDLE = 1e-4
"""Diagonal of J^T J below which a parameter does nothing that float32 differences could tell from round-off."""

FARTHEST = 10.0
"""Ends of an interval, in widths of the range: what logs say nothing of has an error that no float could hold."""

RANGE_DEVIATION = 1 / np.sqrt(12)
"""Standard deviation of a uniform draw from 0 .. 1."""


def determination(linear: Linear, block_ticks: int, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """Return ``parameters`` by name, ``trades`` of pairs, and the number of ``blocks``."""
    normal, gradient = linear.normal()
    at = linear.point
    low, high = (at <= DIFFERENCE) & (gradient > 0), (at >= 1 - DIFFERENCE) & (gradient < 0)
    idle = np.diag(normal) < IDLE
    free = np.flatnonzero(~(low | high | idle))
    values, directions = np.linalg.eigh(normal[np.ix_(free, free)])
    # Along a direction without any slope the error is huge, and not infinite.
    least = 1e-12 * max(float(values.max(initial=0.0)), 1e-12)
    inverse = directions / np.maximum(values, least) @ directions.T
    jacobian, residuals = linear.jacobian[free].astype(np.float64), linear.residuals.astype(np.float64)
    count_within = max(residuals.shape[1] // block_ticks, 1)
    blocks = [
        (slopes[:, k].reshape(free.size, -1), errors[k].reshape(-1))
        for slopes, errors in zip(
            np.array_split(jacobian, count_within, axis=2), np.array_split(residuals, count_within, axis=1), strict=True
        )
        for k in range(len(residuals))
    ]
    # Least squares, as without a block that alone tells something of a parameter the estimate is anywhere.
    moved = np.asarray([
        np.linalg.lstsq(np.eye(free.size) - inverse @ slopes @ slopes.T, inverse @ slopes @ errors, rcond=1e-9)[0]
        for slopes, errors in blocks
    ])  # fmt: skip
    covariance = moved.T @ moved * (len(blocks) - 1) / len(blocks)

    jackknife = np.sqrt(np.diag(covariance))
    # Without correlation, each channel has the variance of its own errors.
    shares = (inverse @ jacobian.reshape(free.size, -1)).reshape(jacobian.shape)
    uncorrelated = (shares**2 * np.mean(residuals**2, axis=(0, 1))).sum(axis=(1, 2, 3))
    error = np.full(len(parameters), np.nan)
    error[free] = np.maximum(jackknife, np.sqrt(uncorrelated))
    correlation = covariance / np.outer(jackknife, jackknife)
    names = [parameters[i].name for i in free]
    pairs = [(float(correlation[i, j]), [names[i], names[j]]) for i, j in combinations(range(free.size), 2)]
    rows = {}
    for i, parameter in enumerate(parameters):
        undetermined = "no effect" if idle[i] else "low end" if low[i] else "high end" if high[i] else None
        rows[parameter.name] = _row(parameter, float(at[i]), float(error[i]), undetermined)
    return {
        "parameters": rows,
        "trades": [
            {"parameters": pair, "correlation": value}
            for value, pair in sorted(pairs, key=lambda pair: -abs(pair[0]))
            if abs(value) > TRADING
        ],
        "blocks": len(blocks),
    }


def _row(parameter: Parameter, at: float, error: float, undetermined: str | None) -> dict[str, Any]:
    row = {"value": parameter.value(at), "unit": parameter.unit, "range": [parameter.low, parameter.high]}
    if undetermined is not None:
        return row | {"standard_error": None, "interval": None, "left": None, "determined": undetermined}
    left = float(error / RANGE_DEVIATION)
    ends = np.clip(at + 1.96 * np.array([-error, error]), -FARTHEST, FARTHEST)
    return row | {
        "standard_error": float(error * parameter.slope(at)),
        "interval": [parameter.value(float(end)) for end in ends],
        "left": left,
        "determined": next(verdict for verdict, most in VERDICTS if left < most),
    }
