"""The local search: least squares in the box of scaled coordinates by SciPy's trust region, Jacobian by differences."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from softfin.tank.calibration.parameters import Point

DIFFERENCE = 2e-3
"""Step of the differences in scaled coordinates: far above float32 round-off, far below any curvature."""

GAIN = 1e-6
"""The search ends when a step lowers the loss by less than this part: little against one over the samples."""


@runtime_checkable
class Fitting(Protocol):
    """What is fitted: points of the box in, errors out."""

    def errors(self, points: Sequence[Point]) -> Iterator[Float[np.ndarray, "pieces compared channels"]]:
        """Yield the errors of each point, divided by each channel's standard deviation."""
        ...


class Linear(NamedTuple):
    """A model about a point: residuals, weighted so that the sum of their squares is the loss, and their slopes."""

    point: Point
    residuals: Float[np.ndarray, "pieces compared channels"]
    jacobian: Float[np.ndarray, "parameters pieces compared channels"]

    @property
    def loss(self) -> float:
        """Weighted mean of 1 - R2 over the channels."""
        return float(np.square(self.residuals, dtype=np.float64).sum())

    def normal(self) -> tuple[Float[np.ndarray, "parameters parameters"], Float[np.ndarray, "parameters"]]:
        """Return J^T J and J^T r."""
        flat = self.jacobian.reshape(len(self.point), -1).astype(np.float64)
        return flat @ flat.T, flat @ self.residuals.reshape(-1).astype(np.float64)

    def bound(self) -> list[bool]:
        """Whether each parameter sits on an end of its range and the loss would fall beyond."""
        _, gradient = self.normal()
        return [
            bool((at <= DIFFERENCE and slope > 0) or (at >= 1 - DIFFERENCE and slope < 0))
            for at, slope in zip(self.point, gradient, strict=True)
        ]


def linearised(fitting: Fitting, point: Point, weights: Float[np.ndarray, "channels"]) -> Linear:
    """Return the model about a point; central differences inside the box, one-sided ones at its faces."""
    up, down = (np.clip(point + sign * DIFFERENCE * np.eye(len(point)), 0.0, 1.0) for sign in (1, -1))
    middle, *sides = fitting.errors([point, *up, *down])
    scale = _scale(middle, weights)
    widths = (up - down).sum(axis=1)
    rise = [
        (high - low) / np.float32(width) * scale
        for high, low, width in zip(sides[: len(point)], sides[len(point) :], widths, strict=True)
    ]
    return Linear(point, middle * scale, np.stack(rise))


def polish(
    fitting: Fitting,
    start: Point,
    weights: Float[np.ndarray, "channels"],
    iterations: int,
    report: Callable[[int, float], None] | None = None,
) -> Linear:
    """Return the model about the best point that is reached from `start` within so many steps."""
    tried: list[float] = []

    def residuals(point: Point) -> Float[np.ndarray, "samples"]:
        errors = next(iter(fitting.errors([point])))
        weighted = (errors * _scale(errors, weights)).reshape(-1).astype(np.float64)
        tried.append(float(weighted @ weighted))
        if report is not None and len(tried) > 1:
            report(min(len(tried) - 1, iterations), float(np.nanmin(tried)))
        return np.asarray(weighted)

    def slopes(point: Point) -> Float[np.ndarray, "samples parameters"]:
        # Beside the last tank with finite readings there may be none.
        jacobian = np.nan_to_num(linearised(fitting, point, weights).jacobian, nan=0.0, posinf=0.0, neginf=0.0)
        return np.asarray(jacobian.reshape(len(point), -1).T, np.float64)

    # Dogbox, as the best point may lie on a face of the box, where the other methods do not go.
    found = least_squares(
        residuals, start, slopes, bounds=(0.0, 1.0), method="dogbox", ftol=GAIN, xtol=1e-8, max_nfev=iterations + 1
    )
    return linearised(fitting, np.asarray(found.x), weights)


def weights_of(values: Sequence[float]) -> Float[np.ndarray, "channels"]:
    """Return the weights divided by their sum."""
    return np.asarray(np.asarray(values) / np.sum(values))


def _scale(errors: np.ndarray, weights: Float[np.ndarray, "channels"]) -> Float[np.ndarray, "channels"]:
    return np.asarray(np.sqrt(weights / (errors.size / len(weights))), np.float32)
