"""The two searches in the box of scaled coordinates: CMA-ES over all of it, then least squares from there.

The state of CMA-ES (Hansen 2016, arXiv:1604.00772) is not saved but repeated: the same seed and the same losses lead to
the same generation. The local search is SciPy's trust region, with the Jacobian by differences.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from softfin.core.errors import RunError
from softfin.core.randomness import cma_es, generator_of
from softfin.tank.calibration.config import Point
from softfin.tank.calibration.model import Errors

Losses = Float[np.ndarray, "generations population"]
Loss = Callable[[Sequence[Point]], Float[np.ndarray, "population"]]
Weights = Float[np.ndarray, "channels"]
"""Weights of the channels, with a sum of 1."""

FAILED = 1e3
"""Loss of a tank whose readings are not finite: worse than any other."""

DIFFERENCE = 2e-3
"""Step of the differences in scaled coordinates: far above float32 round-off, far below any curvature."""

GAIN = 1e-6
"""The search ends when a step lowers the loss by less than this part: little against one over the samples."""


def search(
    loss: Loss,
    start: Point,
    step: float,
    losses: Losses,
    seed: int,
    report: Callable[[int, Losses], None] = lambda done, losses: None,
) -> Point:
    """Return the best point that was tried; `losses` are those known from before, NaN from there on.

    `report` is called with the generations done and all losses so far.

    Raises:
        RunError: no tank of a generation has finite readings.
    """
    random = generator_of(seed, "calibrate/search")
    strategy = cma_es(np.clip(start, 1e-3, 1 - 1e-3), step, random, popsize=losses.shape[1], bounds=[0.0, 1.0])
    losses = losses.copy()
    best, least = start, np.inf
    for generation, row in enumerate(losses):
        points = [np.asarray(point) for point in strategy.ask()]
        if np.isnan(row).any():
            found = loss(points)
            if not np.isfinite(found).any():
                raise RunError("calibrate: no tank of a generation has finite readings; narrow `parameters`")
            row[:] = np.where(np.isfinite(found), found, FAILED)
            report(generation + 1, losses)
        strategy.tell(points, row.tolist())
        if row.min() < least:
            best, least = points[int(row.argmin())], float(row.min())
    return best


def misfits(errors: Errors, points: Sequence[Point]) -> Float[np.ndarray, "points channels"]:
    """Return 1 - R2 of each point and channel; not finite where a tank's readings are not."""
    return np.stack([np.mean(np.square(each, dtype=np.float64), axis=(0, 1)) for each in errors(points)])


class Linear(NamedTuple):
    """A model about a point: residuals, weighted so that the sum of their squares is the loss, and their slopes."""

    point: Point
    residuals: Float[np.ndarray, "segments compared channels"]
    jacobian: Float[np.ndarray, "parameters segments compared channels"]

    @property
    def loss(self) -> float:
        """Weighted mean of 1 - R2 over the channels."""
        return float(np.square(self.residuals, dtype=np.float64).sum())

    def normal(self) -> tuple[Float[np.ndarray, "parameters parameters"], Float[np.ndarray, "parameters"]]:
        """Return J^T J and J^T r."""
        flat = self.jacobian.reshape(len(self.point), -1).astype(np.float64)
        return flat @ flat.T, flat @ self.residuals.reshape(-1).astype(np.float64)


def linearised(errors: Errors, point: Point, weights: Weights) -> Linear:
    """Return the model about a point; central differences inside the box, one-sided ones at its faces."""
    up, down = (np.clip(point + sign * DIFFERENCE * np.eye(len(point)), 0.0, 1.0) for sign in (1, -1))
    middle, *sides = errors([point, *up, *down])
    scale = _scale(middle, weights)
    widths = (up - down).sum(axis=1)
    rise = [
        (high - low) / np.float32(width) * scale
        for high, low, width in zip(sides[: len(point)], sides[len(point) :], widths, strict=True)
    ]
    return Linear(point, middle * scale, np.stack(rise))


def polish(
    errors: Errors,
    start: Point,
    weights: Weights,
    iterations: int,
    report: Callable[[int, float], None] = lambda iteration, loss: None,
) -> Linear:
    """Return the model about the best point that is reached from `start` within so many steps."""
    tried: list[float] = []

    def residuals(point: Point) -> Float[np.ndarray, "samples"]:
        found = next(iter(errors([point])))
        weighted = (found * _scale(found, weights)).reshape(-1).astype(np.float64)
        tried.append(float(weighted @ weighted))
        if len(tried) > 1:
            report(min(len(tried) - 1, iterations), float(np.nanmin(tried)))
        return np.asarray(weighted)

    def slopes(point: Point) -> Float[np.ndarray, "samples parameters"]:
        # Beside the last tank with finite readings there may be none.
        jacobian = np.nan_to_num(linearised(errors, point, weights).jacobian, nan=0.0, posinf=0.0, neginf=0.0)
        return np.asarray(jacobian.reshape(len(point), -1).T, np.float64)

    # Dogbox, as the best point may lie on a face of the box, where the other methods do not go.
    found = least_squares(
        residuals, start, slopes, bounds=(0.0, 1.0), method="dogbox", ftol=GAIN, xtol=1e-8, max_nfev=iterations + 1
    )
    return linearised(errors, np.asarray(found.x), weights)


def _scale(errors: np.ndarray, weights: Weights) -> Float[np.ndarray, "channels"]:
    return np.asarray(np.sqrt(weights / (errors.size / len(weights))), np.float32)
