"""The two searches in the box of scaled coordinates, and the uncertainty of the result.

CMA-ES (Hansen 2016, arXiv:1604.00772) searches the entire box, then least squares starts from the
best point. A resumed run does not load the state of CMA-ES but recomputes it: the same seed and the
same losses produce the same generation. The local search is SciPy's trust region method with a
Jacobian from finite differences.

Standard errors are computed by a jackknife over time blocks in the linear model around the optimum:
each block is left out once. Errors within a block may be correlated, as model errors always are;
blocks are assumed to be independent (Cameron and Miller 2015, J. Human Resources 50, 317, sec.
VI.B). The standard error for uncorrelated errors is a lower bound. A parameter at an end of its
range is treated as fixed. A parameter without any effect, such as a limit that is never reached, is
excluded.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from softfin.core.errors import RunError
from softfin.core.json_object import JsonObject
from softfin.core.randomness import cma_es, named_generator
from softfin.tank.calibration.config import CalibrationPoint, Parameter
from softfin.tank.calibration.model import Errors

Losses = Float[np.ndarray, "generations population"]
ResidualLoss = Callable[[Sequence[CalibrationPoint]], Float[np.ndarray, "population"]]

FAILED = 1e3
"""Loss of a tank whose readings are not finite; higher than any other loss."""

DIFFERENCE = 2e-3
"""Step of the finite differences in scaled coordinates, which is much larger than float32 round-off
and too small for curvature to matter."""

GAIN = 1e-6
"""Relative decrease of the loss below which the local search ends, which is small compared with 1 /
(number of samples)."""


def search(
    loss: ResidualLoss,
    start: CalibrationPoint,
    step: float,
    losses: Losses,
    seed: int,
    report: Callable[[int, Losses], None] = lambda done, losses: None,
) -> CalibrationPoint:
    """Run the global search and return the best point.

    Args:
        loss: Function from the points of a generation to their losses.
        start: Initial mean.
        step: Initial standard deviation in scaled coordinates.
        losses: Losses of completed generations; NaN in all later rows.
        seed: Seed of the search.
        report: Function called after each new generation with the number of generations and all
            losses.

    Raises:
        RunError: If no tank of a generation produced finite readings.
    """
    random = named_generator(seed, "calibrate/search")
    strategy = cma_es(
        np.clip(start, 1e-3, 1 - 1e-3), step, random, popsize=losses.shape[1], bounds=[0.0, 1.0]
    )
    losses = losses.copy()
    best = start
    least = np.inf
    for generation, row in enumerate(losses):
        points = [np.asarray(point) for point in strategy.ask()]
        if np.isnan(row).any():
            found = loss(points)
            if not np.isfinite(found).any():
                raise RunError(
                    "calibrate: no tank in this generation produced finite readings; narrow "
                    "`parameters`"
                )
            row[:] = np.where(np.isfinite(found), found, FAILED)
            report(generation + 1, losses)
        strategy.tell(points, row.tolist())
        if row.min() < least:
            best = points[int(row.argmin())]
            least = float(row.min())
    return best


def misfits(
    errors: Errors, points: Sequence[CalibrationPoint]
) -> Float[np.ndarray, "points channels"]:
    """Return 1 - R2 of each point and channel; not finite if the readings of the tank are not
    finite."""
    rows = [np.mean(np.square(error, dtype=np.float64), axis=(0, 1)) for error in errors(points)]
    return np.stack(rows)


class Linear(NamedTuple):
    """A linear model of the residuals around a point."""

    point: CalibrationPoint
    residuals: Float[np.ndarray, "segments compared channels"]
    """Errors, scaled so that the sum of their squares is the loss."""
    jacobian: Float[np.ndarray, "parameters segments compared channels"]
    """Derivatives of the residuals with respect to the scaled coordinates."""

    @property
    def loss(self) -> float:
        """Mean of 1 - R2 over the channels."""
        return float(np.square(self.residuals, dtype=np.float64).sum())

    def normal(
        self,
    ) -> tuple[Float[np.ndarray, "parameters parameters"], Float[np.ndarray, "parameters"]]:
        """Return J^T J and J^T r."""
        flat = self.jacobian.reshape(len(self.point), -1).astype(np.float64)
        return flat @ flat.T, flat @ self.residuals.reshape(-1).astype(np.float64)


def linearised(errors: Errors, point: CalibrationPoint) -> Linear:
    """Return the linear model around a point, using central differences inside the box and
    one-sided differences on its faces."""
    steps = DIFFERENCE * np.eye(len(point))
    up = np.clip(point + steps, 0.0, 1.0)
    down = np.clip(point - steps, 0.0, 1.0)
    middle, *sides = errors([point, *up, *down])
    scale = _scale(middle)
    highs = np.stack(sides[: len(point)])
    lows = np.stack(sides[len(point) :])
    widths = (up - down).sum(axis=1).astype(np.float32)[:, None, None, None]
    return Linear(point, middle * scale, (highs - lows) / widths * scale)


def polish(
    errors: Errors,
    start: CalibrationPoint,
    iterations: int,
    report: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Linear:
    """Run the local search and return the linear model around its result.

    Args:
        errors: Function that simulates points.
        start: Initial point.
        iterations: Maximum number of steps.
        report: Function called after each step with its number and the lowest loss so far.
    """
    tried: list[float] = []

    def residuals(point: CalibrationPoint) -> Float[np.ndarray, "samples"]:
        found = next(iter(errors([point])))
        scaled = (found * _scale(found)).reshape(-1).astype(np.float64)
        tried.append(float(scaled @ scaled))
        if len(tried) > 1:
            report(min(len(tried) - 1, iterations), float(np.nanmin(tried)))
        return np.asarray(scaled)

    def slopes(point: CalibrationPoint) -> Float[np.ndarray, "samples parameters"]:
        # Tanks next to a tank with finite readings may have readings that are not finite.
        jacobian = np.nan_to_num(
            linearised(errors, point).jacobian, nan=0.0, posinf=0.0, neginf=0.0
        )
        return np.asarray(jacobian.reshape(len(point), -1).T, np.float64)

    # The optimum may be on a face of the box, which SciPy's other method with bounds, trf, only
    # approaches.
    found = least_squares(
        residuals,
        start,
        slopes,
        bounds=(0.0, 1.0),
        method="dogbox",
        ftol=GAIN,
        xtol=1e-8,
        max_nfev=iterations + 1,
    )
    return linearised(errors, np.asarray(found.x))


def _scale(errors: np.ndarray) -> np.float32:
    """Return 1 / sqrt(samples of all channels), so that the sum of squares is the loss."""
    return np.float32(1 / np.sqrt(errors.size))


VERDICTS = (("well", 0.1), ("roughly", 0.5), ("poorly", np.inf))
"""Verdicts on the remaining uncertainty: the standard error divided by the standard deviation of
the range."""

IDLE = 1e-4
"""Diagonal element of J^T J below which the effect of a parameter is indistinguishable from float32
round-off."""

FARTHEST = 10.0
"""Bound on the ends of an interval in scaled coordinates; without it, the value of an undetermined
parameter could overflow."""

RANGE_DEVIATION = 1 / np.sqrt(12)
"""Standard deviation of a uniform distribution on [0, 1]."""


def determination(
    linear: Linear, block_ticks: int, parameters: tuple[Parameter, ...]
) -> JsonObject:
    """Estimate how well the logs determine the parameters.

    Returns:
        ``parameters``, keyed by name, and the number of ``blocks``.
    """
    normal, gradient = linear.normal()
    at = linear.point
    # Parameters at an end of their range, if the loss would decrease beyond it.
    low = (at <= DIFFERENCE) & (gradient > 0)
    high = (at >= 1 - DIFFERENCE) & (gradient < 0)
    idle = np.diag(normal) < IDLE
    free = np.flatnonzero(~(low | high | idle))
    values, directions = np.linalg.eigh(normal[np.ix_(free, free)])
    # The pseudo-inverse N^-1 of N = J^T J, with eigenvalues bounded from below: in a direction
    # without any effect, the error becomes huge but not infinite.
    least = 1e-12 * max(float(values.max(initial=0.0)), 1e-12)
    inverse = directions / np.maximum(values, least) @ directions.T
    jacobian = linear.jacobian[free].astype(np.float64)
    residuals = linear.residuals.astype(np.float64)
    count_within = max(residuals.shape[1] // block_ticks, 1)
    # Leaving out block b moves the estimate. With N = J^T J, to which the block contributes
    # J_b^T J_b, (1 - N^-1 J_b^T J_b) move = N^-1 J_b^T r_b. This is solved by least squares,
    # because the matrix is singular if only this block determines a parameter.
    moves = []
    for ticks in np.array_split(np.arange(residuals.shape[1]), count_within):
        for segment in range(len(residuals)):
            slopes = jacobian[:, segment, ticks].reshape(free.size, -1)
            left = np.eye(free.size) - inverse @ slopes @ slopes.T
            right = inverse @ slopes @ residuals[segment, ticks].reshape(-1)
            moves.append(np.linalg.lstsq(left, right, rcond=1e-9)[0])
    # The jackknife estimate: covariance = (B - 1) / B * sum over blocks of move move^T.
    moved = np.asarray(moves)
    covariance = moved.T @ moved * (len(moves) - 1) / len(moves)

    jackknife = np.sqrt(np.diag(covariance))
    # For uncorrelated errors with variance s_c^2 in channel c, the variance of the estimate is the
    # sum of (N^-1 J^T)^2 s_c^2 over all residuals.
    shares = (inverse @ jacobian.reshape(free.size, -1)).reshape(jacobian.shape)
    uncorrelated = (shares**2 * np.mean(residuals**2, axis=(0, 1))).sum(axis=(1, 2, 3))
    error = np.full(len(parameters), np.nan)
    error[free] = np.maximum(jackknife, np.sqrt(uncorrelated))
    rows = {}
    for i, parameter in enumerate(parameters):
        reason = None
        if idle[i]:
            reason = "no effect"
        elif low[i]:
            reason = "low end"
        elif high[i]:
            reason = "high end"
        rows[parameter.name] = _row(parameter, float(at[i]), float(error[i]), reason)
    return {"parameters": rows, "blocks": len(moves)}


def _row(parameter: Parameter, at: float, error: float, undetermined: str | None) -> JsonObject:
    row: JsonObject = {
        "value": parameter.value(at),
        "unit": parameter.unit,
        "range": [parameter.low, parameter.high],
        "standard_error": None,
        "interval": None,
        "left": None,
        "determined": undetermined,
    }
    if undetermined is None:
        left = float(error / RANGE_DEVIATION)
        # 95% of a normal distribution is within 1.96 standard deviations of the mean.
        ends = np.clip(at + 1.96 * np.array([-error, error]), -FARTHEST, FARTHEST)
        row["standard_error"] = float(error * parameter.slope(at))
        row["interval"] = [parameter.value(float(end)) for end in ends]
        row["left"] = left
        row["determined"] = next(verdict for verdict, most in VERDICTS if left < most)
    return row
