"""Errors over a controller's full range: on a lattice of references, and at random references.

All references run in one compiled program, each from rest, with one seed.
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
"""Reference forces (x, y) [N]."""

LATTICE_POINTS = 7
"""Default number of references along each side of the lattice."""

MAX_RANDOM = 10_000
"""Maximum number of random references; they all run together."""

ROUNDS = 100
"""Number of draws of the requested size after which the cells are treated as unreachable."""


class ErrorMap(NamedTuple):
    """Errors on a lattice of references."""

    cell: Cell
    """Range of the controller, divided into equal parts; each reference is the centre of one."""
    points: int
    """Number of references along each side."""
    references: ReferenceForces
    """References that the controller covers and the fin can reach [N]; the rest of the
    ``points ** 2`` references are omitted."""
    error: ReferenceForces
    """Mean |moving average - reference| [N]."""
    reachable: Float[np.ndarray, "corners 2"] | None = None
    """Outline of the reachable mean forces [N]; None if unknown."""
    not_reachable: int = 0
    """Number of references that the controller covers but the fin cannot reach."""

    def to_dict(self) -> ErrorMapRows:
        """Return the map as values for JSON."""
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
    """Return the bounding box of a controller's cells.

    A controller without cells covers everything; its range is the paper's.
    """
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
    """Compute the errors on a lattice over the controller's range; raises CoverageError if none of
    its references can be tracked."""
    cell = controller_range(controller)
    reachable = reachable_set(controller)
    outline = None if reachable is None else reachable.corners()
    if cell.low[0] == cell.high[0] or cell.low[1] == cell.high[1]:
        raise CoverageError(
            f"error map over {cell}: the controller's range has no area; train it for a larger cell"
        )

    def covers(reference: ForceVector) -> bool:
        try:
            controller.check(reference)
        except CoverageError:
            return False
        return True

    # Without any covered reference, the array would otherwise have no second axis.
    covered = np.array(list(filter(covers, cell.lattice(points)))).reshape(-1, 2)
    references = covered if reachable is None else covered[reachable.contains(covered)]
    if not len(references):
        raise CoverageError(
            f"error map of {points} x {points} references over {cell}: the controller covers "
            f"{len(covered)} of them, but the fin can reach none of those; use more points, or "
            "train the controller for reachable forces (run softfin map to plot them)"
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
    """Compute the errors at random references within the controller's cells and the fin's reachable
    forces.

    The 95th percentile is over the references.
    """
    cells = controller_cells(controller) or (PAPER_RANGE,)
    references = draw_references(
        cells, reachable_set(controller), count, named_generator(seed, "evaluate/random")
    )
    errors = errors_at(controller, plant, references, seconds, key)
    x = _random_errors(references, errors[:, 0])
    y = _random_errors(references, errors[:, 1])
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
    """Draw forces uniformly over the reachable part of the cells; raises CoverageError if hardly
    any force in them is reachable.

    If no cell has an area (all are points or lines), each is chosen with equal probability.
    """
    # Rejection sampling: choose a cell in proportion to its area, draw a force uniformly within it,
    # and keep the force if it is reachable.
    low = np.array([cell.low for cell in cells], float)
    high = np.array([cell.high for cell in cells], float)
    area = np.prod(high - low, axis=1)
    probability = area / area.sum() if area.any() else np.full(len(cells), 1 / len(cells))
    accepted = np.zeros((0, 2))
    for _ in range(ROUNDS):
        chosen = generator.choice(len(cells), count, p=probability)
        forces = generator.uniform(low[chosen], high[chosen])
        if reachable is not None:
            forces = forces[reachable.contains(forces)]
        accepted = np.concatenate([accepted, forces])
        if len(accepted) >= count:
            return accepted[:count]
    raise CoverageError(
        f"random = {count}: this fin can reach only {len(accepted)} of {count * ROUNDS} references "
        "drawn from the controller's cells; train the controller for reachable forces (run softfin "
        "map to plot them)"
    )
