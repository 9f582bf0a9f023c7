"""How well the logs determine each parameter, from the residuals and their slopes at the optimum.

The covariance is that of the jackknife over blocks of time, in the linear model about the optimum: each block is left
out once, and the estimates that remain are compared. Errors within a block may then be correlated in any way, as those
of a model always are; blocks are taken as independent (Cameron and Miller 2015, J. Human Resources 50, 317, sec. VI.B).
Where a few strokes say most, even that is too small by chance, so no standard error is less than the one for errors
without any correlation. A parameter that sits on an end of its range is taken as known there, and one without any
effect, such as a limit that is never met, is left out.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from softfin.tank.calibration.parameters import Parameter
from softfin.tank.calibration.polish import Linear

TRADING = 0.9
"""Correlation from which two parameters are said to trade against each other."""

VERDICTS = (("well", 0.1), ("roughly", 0.5), ("poorly", np.inf))
"""By the share of what was unknown that is left: standard error over the standard deviation of the whole range."""

IDLE = 1e-4
"""Diagonal of J^T J below which a parameter does nothing that float32 differences could tell from round-off."""

FARTHEST = 10.0
"""Ends of an interval, in widths of the range: what logs say nothing of has an error that no float could hold."""

RANGE_DEVIATION = 1 / np.sqrt(12)
"""Standard deviation of a uniform draw from 0 .. 1."""


class Determination(NamedTuple):
    """How well parameters are determined, in scaled coordinates; NaN for those on a bound and those without effect."""

    error: Float[np.ndarray, "parameters"]
    """Standard error [-]."""
    correlation: Float[np.ndarray, "parameters parameters"]
    singular: Float[np.ndarray, "free"]
    """Singular values of J, greatest first: the root of 1 - R2 that a whole range along a direction would cost [-]."""
    weakest: Float[np.ndarray, "parameters"]
    """The direction of the least singular value, of length 1: what the logs tell least about."""
    bound: list[bool]
    """On an end of the range."""
    idle: list[bool]
    """Without any effect: a whole range of it would cost less than 1e-4 of R2."""
    blocks: int
    """Blocks of time that were counted as independent."""


def determination(linear: Linear, block_ticks: int) -> Determination:
    """At the point of `linear`, with blocks of so many ticks."""
    normal, bound = linear.normal()[0], linear.bound()
    idle = (np.diag(normal) < IDLE).tolist()
    free = np.flatnonzero(~(np.array(bound) | idle))
    inverse = _inverse(normal[np.ix_(free, free)])
    moved = _left_out(linear, free, block_ticks, inverse)
    blocks = len(moved)
    covariance = moved.T @ moved * (blocks - 1) / blocks
    count = len(bound)
    error, correlation = np.full(count, np.nan), np.full((count, count), np.nan)
    jackknife = np.sqrt(np.diag(covariance))
    error[free] = np.maximum(jackknife, _uncorrelated(linear, free, inverse))
    correlation[np.ix_(free, free)] = covariance / np.outer(jackknife, jackknife)
    values, directions = np.linalg.eigh(normal[np.ix_(free, free)])
    weakest = np.zeros(count)
    weakest[free] = directions[:, 0] if free.size else 0.0
    return Determination(error, correlation, np.sqrt(np.maximum(values[::-1], 0.0)), weakest, bound, idle, blocks)


def parameters_to_dict(found: Determination, linear: Linear, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """For JSON: ``parameters`` by name, ``trades``, ``correlation``, ``singular_values``, ``weakest``, ``blocks``."""
    names = [parameter.name for parameter in parameters]
    rows = zip(parameters, linear.point, found.error, _fates(found, linear), strict=True)
    pairs = np.argwhere(np.triu(np.abs(np.nan_to_num(found.correlation)), 1) > TRADING)
    return {
        "parameters": {one.name: _row(one, float(at), float(error), fate) for one, at, error, fate in rows},
        "trades": [
            {"parameters": [names[i], names[j]], "correlation": float(found.correlation[i, j])}
            for i, j in sorted(pairs.tolist(), key=lambda ij: -abs(found.correlation[ij[0], ij[1]]))
        ],
        "correlation": [[None if np.isnan(c) else float(c) for c in row] for row in found.correlation],
        "singular_values": found.singular.tolist(),
        "weakest": {
            names[i]: float(found.weakest[i]) for i in np.argsort(-np.abs(found.weakest)) if abs(found.weakest[i]) > 0.1
        },
        "blocks": found.blocks,
    }


def _fates(found: Determination, linear: Linear) -> list[str | None]:
    """Why a parameter has no standard error, where it has none."""
    return [
        "no effect" if idle else f"{'low' if at < 0.5 else 'high'} end" if bound else None
        for at, bound, idle in zip(linear.point, found.bound, found.idle, strict=True)
    ]


def _row(parameter: Parameter, at: float, error: float, fate: str | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "value": parameter.value(at),
        "unit": parameter.unit,
        "range": [parameter.low, parameter.high],
    }
    if fate is not None:
        return row | {"standard_error": None, "interval": None, "left": None, "determined": fate}
    left = float(error / RANGE_DEVIATION)
    ends = np.clip(at + 1.96 * np.array([-error, error]), -FARTHEST, FARTHEST)
    return row | {
        "standard_error": float(error * parameter.slope(at)),
        "interval": [parameter.value(float(end)) for end in ends],
        "left": left,
        "determined": next(verdict for verdict, most in VERDICTS if left < most),
    }


def _uncorrelated(
    linear: Linear, free: Int[np.ndarray, "free"], inverse: Float[np.ndarray, "free free"]
) -> Float[np.ndarray, "free"]:
    """Standard errors by the formula of least squares, each channel with the variance of its own errors."""
    variance = np.mean(np.square(linear.residuals, dtype=np.float64), axis=(0, 1))
    slopes = (linear.jacobian[free] * np.sqrt(variance)).reshape(free.size, -1).astype(np.float64)
    return np.asarray(np.sqrt(np.diag(inverse @ (slopes @ slopes.T) @ inverse)))


def _left_out(
    linear: Linear, free: Int[np.ndarray, "free"], ticks: int, inverse: Float[np.ndarray, "free free"]
) -> Float[np.ndarray, "blocks free"]:
    """How far the estimate moves when a block is left out, for each block of each piece."""
    count = max(linear.residuals.shape[1] // ticks, 1)
    moved = []
    for piece in range(len(linear.residuals)):
        parts = zip(
            np.array_split(linear.jacobian[free, piece], count, axis=1),
            np.array_split(linear.residuals[piece], count),
            strict=True,
        )
        for slopes, errors in parts:
            flat = slopes.reshape(free.size, -1).astype(np.float64)
            rest = np.eye(free.size) - inverse @ flat @ flat.T
            # Without a block that alone tells something of a parameter, that estimate is anywhere.
            moved.append(np.linalg.lstsq(rest, inverse @ flat @ errors.reshape(-1).astype(np.float64), rcond=1e-9)[0])
    return np.asarray(moved)


def _inverse(matrix: Float[np.ndarray, "free free"]) -> Float[np.ndarray, "free free"]:
    """Invert a matrix that may be singular along some direction, whose error is then huge and not infinite."""
    values, directions = np.linalg.eigh(matrix)
    least = 1e-12 * max(float(values.max(initial=0.0)), 1e-12)
    return np.asarray(directions / np.maximum(values, least) @ directions.T)
