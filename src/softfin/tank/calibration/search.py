"""The global search: CMA-ES (Hansen 2016, arXiv:1604.00772) in the box of scaled coordinates, losses as its only input.

Its state is not saved but repeated: the same seed and the same losses lead to the same generation.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from softfin.core.errors import RunError
from softfin.core.evolution import cma_es
from softfin.core.randomness import generator_of
from softfin.tank.calibration.parameters import Point

Losses = Float[np.ndarray, "generations population"]
Loss = Callable[[Sequence[Point]], Float[np.ndarray, "population"]]
Report = Callable[[int, Losses], None]
"""Called with the generations done and all losses so far, NaN where none is yet."""

FAILED = 1e3
"""Loss of a tank whose readings are not finite: worse than any other."""


def search(
    loss: Loss, start: Point, step: float, losses: Losses, seed: int, report: Report | None = None
) -> tuple[Point, float]:
    """The best point that was tried, and its loss; `losses` are those known from before, NaN from there on.

    Raises:
        RunError: no tank of a generation has finite readings.
    """
    generations, population = losses.shape
    random = generator_of(seed, "calibrate/search")
    strategy = cma_es(np.clip(start, 1e-3, 1 - 1e-3), step, random, popsize=population, bounds=[0.0, 1.0])
    losses = losses.copy()
    best, least = start, np.inf
    for generation in range(generations):
        points = [np.asarray(point) for point in strategy.ask()]
        if np.isnan(losses[generation]).any():
            found = loss(points)
            if not np.isfinite(found).any():
                raise RunError("calibrate: no tank of a generation has finite readings; narrow `parameters`")
            losses[generation] = np.where(np.isfinite(found), found, FAILED)
            if report is not None:
                report(generation + 1, losses)
        strategy.tell(points, losses[generation].tolist())
        first = int(losses[generation].argmin())
        if losses[generation, first] < least:
            best, least = points[first], float(losses[generation, first])
    return best, least
