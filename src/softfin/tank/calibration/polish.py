"""The local search: Levenberg-Marquardt in the box of scaled coordinates, Jacobian by differences, all in batches."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from softfin.tank.calibration.parameters import Point

DIFFERENCE = 2e-3
"""Between a point and its neighbours in scaled coordinates: far above float32 round-off, far below any curvature."""

DAMPINGS = 10.0 ** np.arange(-3, 3)
"""Tried at once, times the one that was best before."""

MOST_DAMPING = 1e6
"""Beyond it a step is none."""

GAIN = 1e-6
"""The search ends when a step lowers the loss by less than this share: little against one over the samples."""


@runtime_checkable
class Fitting(Protocol):
    """What is fitted: points of the box in, errors out."""

    def errors(self, points: Sequence[Point]) -> Iterator[Float[np.ndarray, "pieces compared channels"]]:
        """Of each point, over each channel's standard deviation."""
        ...

    def misfits(self, points: Sequence[Point]) -> Float[np.ndarray, "points channels"]:
        """Their mean squares by channel."""
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
        """J^T J and J^T r."""
        flat = self.jacobian.reshape(len(self.point), -1).astype(np.float64)
        return flat @ flat.T, flat @ self.residuals.reshape(-1).astype(np.float64)

    def bound(self) -> list[bool]:
        """Of each parameter, whether it sits on an end of its range and the loss would fall beyond."""
        _, gradient = self.normal()
        return [
            bool((at <= DIFFERENCE and slope > 0) or (at >= 1 - DIFFERENCE and slope < 0))
            for at, slope in zip(self.point, gradient, strict=True)
        ]


def linearised(fitting: Fitting, point: Point, weights: Float[np.ndarray, "channels"]) -> Linear:
    """The model about a point; central differences inside the box, one-sided ones at its faces."""
    up, down = (np.clip(point + sign * DIFFERENCE * np.eye(len(point)), 0.0, 1.0) for sign in (1, -1))
    middle, *sides = fitting.errors([point, *up, *down])
    scale = np.sqrt(weights / (middle.size / len(weights))).astype(np.float32)
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
    """The model about the best point that is reached from `start`."""
    here, damping = linearised(fitting, start, weights), 1e-2
    for iteration in range(iterations):
        before = here.loss
        steps = [_step(here, damping * factor) for factor in DAMPINGS]
        tried = fitting.misfits(steps) @ weights
        tried = np.where(np.isfinite(tried), tried, np.inf)
        best = int(np.argmin(tried))
        if report is not None:
            report(iteration + 1, min(before, float(tried[best])))
        if tried[best] >= before:
            damping *= DAMPINGS[-1] / DAMPINGS[0]
            if damping > MOST_DAMPING:
                break
            continue
        here, damping = linearised(fitting, steps[best], weights), max(damping * float(DAMPINGS[best]), 1e-6)
        if here.loss > (1 - GAIN) * before:
            break
    return here


def _step(here: Linear, damping: float) -> Point:
    normal, gradient = here.normal()
    free = ~np.array(here.bound())
    inner = normal[np.ix_(free, free)]
    step = np.zeros_like(here.point)
    step[free] = -np.linalg.solve(inner + damping * np.diag(np.diag(inner) + 1e-12), gradient[free])
    return np.asarray(np.clip(here.point + step, 0.0, 1.0))


def weights_of(values: Sequence[float]) -> Float[np.ndarray, "channels"]:
    """Summing to one."""
    return np.asarray(np.asarray(values) / np.sum(values))
