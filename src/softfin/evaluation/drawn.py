"""How well a controller holds forces drawn at random over all that it was trained for and its fin can make."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.control.controller import Controller
from softfin.control.references import cells_of, reachable_of
from softfin.core.errors import CoverageError
from softfin.core.quantities import AXES
from softfin.core.randomness import generator_of
from softfin.evaluation.experiment import Subject
from softfin.evaluation.forceplane import error_map
from softfin.gaits.reachable import Cell, Reachable
from softfin.task.references import PAPER_RANGE

MOST = 10_000
"""References that run side by side."""

ROUNDS = 100
"""Draws of as many references as are missing, until the cells count as beyond the fin's reach."""


class Drawn(NamedTuple):
    """Errors over random references."""

    references: Float[np.ndarray, "references 2"]
    """(x, y) [N]."""
    error: Float[np.ndarray, "references 2"]
    """Mean |moving average - reference| [N]."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON; the 95th percentile is over the references."""
        return {
            "count": len(self.references),
            "seeds": 1,
            **{
                axis: {
                    "mean_n": float(self.error[:, i].mean()),
                    "p95_n": float(np.percentile(self.error[:, i], 95)),
                    "worst_n": float(self.error[:, i].max()),
                    "worst_reference_n": self.references[self.error[:, i].argmax()].round(4).tolist(),
                }
                for i, axis in enumerate(AXES)
            },
        }


def hold_drawn(controller: Controller, plant: Subject, count: int, seed: int, seconds: int, key: PRNGKeyArray) -> Drawn:
    """Hold `count` references drawn from `seed`, each from rest on one seed of the plant."""
    cells = cells_of(controller) or (PAPER_RANGE,)
    references = draw(cells, reachable_of(controller), count, generator_of(seed, "evaluate/random"))
    return Drawn(references, error_map(controller, plant, references, seconds, key))


def draw(
    cells: Sequence[Cell], reachable: Reachable | None, count: int, generator: np.random.Generator
) -> Float[np.ndarray, "references 2"]:
    """Forces uniform over the part of the cells that the fin can make; raises CoverageError where it makes hardly any.

    Cells of no area, which hold single references or lines, are drawn from alike where no other has any.
    """
    low, high = (np.array([getattr(cell, corner) for cell in cells], float) for corner in ("low", "high"))
    area = np.prod(high - low, axis=1)
    share = area / area.sum() if area.any() else np.full(len(cells), 1 / len(cells))
    found = np.zeros((0, 2))
    for _ in range(ROUNDS):
        chosen = generator.choice(len(cells), count, p=share)
        drawn = generator.uniform(low[chosen], high[chosen])
        found = np.concatenate([found, drawn if reachable is None else drawn[reachable.contains(drawn)]])
        if len(found) >= count:
            return found[:count]
    raise CoverageError(
        f"random = {count}: of {count * ROUNDS} references drawn over the controller's cells this fin can make "
        f"{len(found)}; train the controller within the fin's reach (softfin map shows it)"
    )
