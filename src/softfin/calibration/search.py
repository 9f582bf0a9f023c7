"""The global search: CMA-ES (Hansen 2016, arXiv:1604.00772) in the box of scaled coordinates, losses as its only input.

Its state is not saved but repeated: the same seed and the same losses lead to the same generation.
"""

from collections.abc import Callable, Sequence
from typing import Any

import cma
import numpy as np
from jaxtyping import Float

from softfin.calibration.parameters import Point
from softfin.errors import RunError
from softfin.randomness import generator_of

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
    strategy = _strategy(start, step, population, seed)
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


def _strategy(start: Point, step: float, population: int, seed: int) -> Any:
    generator = generator_of(seed, "calibrate/search")
    # A seed of NaN and an own source of randomness keep the library from seeding NumPy for the whole process.
    options = {
        "bounds": [0.0, 1.0],
        "popsize": population,
        "randn": lambda *shape: generator.standard_normal(shape),
        "seed": np.nan,
        "verbose": -9,
    }
    return cma.CMAEvolutionStrategy(np.clip(start, 1e-3, 1 - 1e-3), step, options)
