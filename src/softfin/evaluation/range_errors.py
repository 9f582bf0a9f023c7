"""Errors over a controller's whole range: at a lattice of references, and at references drawn at
random.

Controller and plant go in; all references run in one compiled program, each from rest, at one seed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.control.controller import Controller
from softfin.control.references import controller_cells, reachable_set
from softfin.core.errors import CoverageError
from softfin.core.randomness import named_generator
from softfin.evaluation.experiment import EvaluationTarget, independent, run
from softfin.evaluation.results import ErrorMapPoint, ErrorMapRows, RandomAxisErrors, RandomErrors
from softfin.evaluation.scores import score
from softfin.gaits.reachable import Cell, ForceVector, Reachable, bounding_box
from softfin.task.references import PAPER_RANGE

ReferenceForces = Float[np.ndarray, "references 2"]
"""(x, y) [N]."""

LATTICE_POINTS = 7
"""Default number of references along each side of the lattice."""

MAX_RANDOM = 10_000
"""Largest number of random references, which run together."""

ROUNDS = 100
"""Number of draws of the requested size before the cells count as out of the fin's reach."""


class ErrorMap(NamedTuple):
    """Errors at the references of a lattice."""

    cell: Cell
    """Range of the controller; each reference is the centre of an equal part of it."""
    points: int
    """References along each side."""
    references: ReferenceForces
    """References that the controller covers and the fin can make [N]; the others of ``points ** 2``
    are left out."""
    error: ReferenceForces
    """Mean |moving average - reference| [N]."""
    reachable: Float[np.ndarray, "corners 2"] | None = None
    """Outline of the mean forces that the fin can make [N]; None if unknown."""
    not_reachable: int = 0
    """Number of references of the lattice that the controller covers but the fin cannot make."""

    def to_dict(self) -> ErrorMapRows:
        """Values for JSON."""
        rows: list[ErrorMapPoint] = [
            {"reference_n": reference, "error_x_n": x, "error_y_n": y}
            for reference, (x, y) in zip(self.references.tolist(), self.error.tolist(), strict=True)
        ]
        return {
            "points": self.points,
            "low_n": list(self.cell.low),
            "high_n": list(self.cell.high),
            "seeds": 1,
            "not_covered": self.points**2 - len(rows) - self.not_reachable,
            "not_reachable": self.not_reachable,
            "references": rows,
            "mean_x_n": float(self.error[:, 0].mean()),
            "mean_y_n": float(self.error[:, 1].mean()),
            "worst_x_n": float(self.error[:, 0].max()),
            "worst_y_n": float(self.error[:, 1].max()),
        }


def controller_range(controller: Controller) -> Cell:
    """Return the bounding box of a controller's cells; the paper's range for one without cells,
    which covers everything."""
    return bounding_box(controller_cells(controller) or (PAPER_RANGE,))


def errors_at(
    controller: Controller,
    plant: EvaluationTarget,
    references: ReferenceForces,
    seconds: int,
    key: PRNGKeyArray,
) -> ReferenceForces:
    """Return mean |moving average - reference| for each reference [N]."""
    recording = run(
        controller, plant, np.asarray(references, np.float32), seconds, jnp.stack([key])
    )
    return score(independent(recording)).error[:, 0]


def map_errors(
    controller: Controller, plant: EvaluationTarget, points: int, seconds: int, key: PRNGKeyArray
) -> ErrorMap:
    """Compute the errors over a lattice of the controller's range; raises CoverageError if no
    reference in it can be tracked."""
    cell = controller_range(controller)
    reachable = reachable_set(controller)
    outline = None if reachable is None else reachable.corners()
    if cell.low[0] == cell.high[0] or cell.low[1] == cell.high[1]:
        raise CoverageError(
            f"an error map over {cell}: the controller's range has no area; train it for a wider "
            "cell"
        )

    def covers(reference: ForceVector) -> bool:
        try:
            controller.check(reference)
        except CoverageError:
            return False
        return True

    covered = np.array(
        [reference for reference in cell.lattice(points) if covers(reference)]
    ).reshape(-1, 2)
    references = covered if reachable is None else covered[reachable.contains(covered)]
    if not len(references):
        raise CoverageError(
            f"an error map of {points} x {points} references over {cell}: the controller covers "
            f"{len(covered)} of them and the fin can make none of those; ask for more points, or "
            "train the controller within the fin's reach (softfin map shows it)"
        )
    error = errors_at(controller, plant, references, seconds, key)
    return ErrorMap(cell, points, references, error, outline, len(covered) - len(references))


def random_errors(
    controller: Controller,
    plant: EvaluationTarget,
    count: int,
    seed: int,
    seconds: int,
    key: PRNGKeyArray,
) -> RandomErrors:
    """Compute the errors at references drawn from `seed` over the controller's cells and the fin's
    reach.

    The 95th percentile is over the references.
    """
    cells = controller_cells(controller) or (PAPER_RANGE,)
    references = draw_references(
        cells, reachable_set(controller), count, named_generator(seed, "evaluate/random")
    )
    errors = errors_at(controller, plant, references, seconds, key)
    x, y = (_random_errors(references, error) for error in errors.T)
    return {"count": count, "seeds": 1, "x": x, "y": y}


def _random_errors(
    references: ReferenceForces, error: Float[np.ndarray, "references"]
) -> RandomAxisErrors:
    return {
        "mean_n": float(error.mean()),
        "p95_n": float(np.percentile(error, 95)),
        "worst_n": float(error.max()),
        "worst_reference_n": references[error.argmax()].round(4).tolist(),
    }


def draw_references(
    cells: Sequence[Cell], reachable: Reachable | None, count: int, generator: np.random.Generator
) -> ReferenceForces:
    """Draw forces uniformly over the part of the cells that the fin can make; raises CoverageError
    if it can make hardly any.

    If no cell has an area, because all are single references or lines, they are drawn from with
    equal probability.
    """
    # Rejection sampling: a cell by its area, a force uniform in it, kept if the fin can make it.
    low, high = (
        np.array([getattr(cell, corner) for cell in cells], float) for corner in ("low", "high")
    )
    area = np.prod(high - low, axis=1)
    probability = area / area.sum() if area.any() else np.full(len(cells), 1 / len(cells))
    accepted = np.zeros((0, 2))
    for _ in range(ROUNDS):
        chosen = generator.choice(len(cells), count, p=probability)
        forces = generator.uniform(low[chosen], high[chosen])
        accepted = np.concatenate(
            [accepted, forces if reachable is None else forces[reachable.contains(forces)]]
        )
        if len(accepted) >= count:
            return accepted[:count]
    raise CoverageError(
        f"random = {count}: of {count * ROUNDS} references drawn over the controller's cells this "
        f"fin can make {len(accepted)}; train the controller within the fin's reach (softfin map "
        "shows it)"
    )
