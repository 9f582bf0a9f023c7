"""Errors over the full range of a controller, at random references.

One compiled program runs all references, each from rest and with one seed.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from softfin.control.controller import Controller
from softfin.control.references import controller_cells, reachable_set
from softfin.core.errors import CoverageError
from softfin.core.randomness import named_generator
from softfin.evaluation.experiment import EvaluationTarget, independent, run
from softfin.evaluation.results import RangeErrors
from softfin.evaluation.scores import score
from softfin.gaits.reachable import Cell, bounding_box
from softfin.task.references import PAPER_RANGE

ReferenceForces = Float[np.ndarray, "references 2"]
"""Reference forces (x, y) [N]."""

MAX_RANDOM = 10_000
"""Maximum number of random references, which all run together."""

ROUNDS = 100
"""Number of forces drawn per random reference; if too few are reachable, the cells are treated as
unreachable."""


def summarize(references: ReferenceForces, error: ReferenceForces) -> RangeErrors:
    """Return the errors (x, y) at many references [N] as values for JSON."""
    return {
        "references_n": references.round(4).tolist(),
        "errors_n": error.tolist(),
        "mean_n": error.mean(axis=0).tolist(),
        "p95_n": np.percentile(error, 95, axis=0).tolist(),
        "worst_n": error.max(axis=0).tolist(),
    }


def controller_range(controller: Controller) -> Cell:
    """Return the bounding box of a controller's cells.

    A controller without cells covers every reference; the paper's range is used for it.
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


def random_errors(
    controller: Controller,
    plant: EvaluationTarget,
    count: int,
    seed: int,
    seconds: int,
    key: PRNGKeyArray,
) -> RangeErrors:
    """Compute the errors at random references within the cells of the controller and the reachable
    region of the fin."""
    references = draw_references(controller, count, named_generator(seed, "evaluate/random"))
    return summarize(references, errors_at(controller, plant, references, seconds, key))


def draw_references(
    controller: Controller, count: int, generator: np.random.Generator
) -> ReferenceForces:
    """Draw forces uniformly over the reachable part of a controller's cells; raises CoverageError
    if hardly any force in the cells is reachable."""
    cell = controller_range(controller)
    forces = generator.uniform(cell.low, cell.high, (ROUNDS * count, 2))
    accepted = np.zeros(len(forces), bool)
    for part in controller_cells(controller) or (cell,):
        accepted |= ((forces >= part.low) & (forces <= part.high)).all(axis=1)
    reachable = reachable_set(controller)
    if reachable is not None:
        accepted &= reachable.contains(forces)
    references = forces[accepted][:count]
    if len(references) < count:
        raise CoverageError(
            f"random = {count}: this fin can reach only {len(references)} of {len(forces)} "
            "references drawn from the range of the controller; train the controller for reachable "
            "forces (run softfin map to plot them)"
        )
    return references
