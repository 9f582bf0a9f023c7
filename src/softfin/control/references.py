"""References that a controller can hold: those of its cells, and among them the forces that the fin
can make."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from softfin.core.errors import CoverageError
from softfin.gaits.reachable import Cell, Cells, ForceVector, Reachable, format_force

EDGE_N = 1e-4
"""References this near to a cell are on its edge: forces are float32, and their decimals seldom
come out even."""


def controller_cells(controller: object) -> Cells:
    """Return the cells that a controller was trained for; none of one that has no `cells` and
    covers everything."""
    return cast(Cells, getattr(controller, "cells", None) or ())


def reachable_set(controller: object) -> Reachable | None:
    """Return the mean forces that the fin can make, where the controller knows them."""
    return cast(Reachable | None, getattr(controller, "reachable", None))


def check_within(cells: Sequence[Cell], reference: ForceVector) -> None:
    """Raise CoverageError where the reference is outside every cell."""
    nearest = min(cells, key=lambda cell: cell.distance(reference))
    beyond = nearest.distance(reference)
    if beyond > EDGE_N:
        which = (
            f"the nearest of {len(cells)} cells"
            if len(cells) > 1
            else "what this controller was trained for"
        )
        raise CoverageError(
            f"reference {format_force(reference)} N: {beyond:.2g} N outside {which} "
            f"({nearest}); ask within {'a cell' if len(cells) > 1 else 'it'}, or train with "
            f"{'a' if len(cells) > 1 else 'a wider'} cell there"
        )


def resolve_reference(
    controller: object, reference: ForceVector, strict: bool
) -> tuple[ForceVector, str | None]:
    """Return the reference to track, and a warning where that is another: the nearest force that
    the fin can make.

    That force lies in the controller's cells. Raises CoverageError where the fin cannot make the
    reference and `strict`, or where the controller was not trained for it.
    """
    if not np.isfinite(reference).all():
        raise CoverageError(f"reference {format_force(reference)} N: give two finite numbers [N]")
    x, y = nearest_trackable(controller, np.array([reference], float))[0].tolist()
    # To the last bit it is what was asked for, unless it is another one.
    if (x, y) == tuple(reference):
        return reference, None
    problem = unreachable(reference, (x, y))
    if strict:
        raise CoverageError(f"{problem}; ask for that, or leave out --strict")
    return (x, y), f"{problem}, which is held instead"


def nearest_trackable(
    controller: Any, forces: Float[np.ndarray, "forces 2"]
) -> Float[np.ndarray, "forces 2"]:
    """Return each force, or where the fin cannot make it the nearest one that it can make in the
    controller's cells.

    Raises CoverageError for one that the fin can make but the controller was not trained for, and
    where the fin can make nothing that it was trained for.
    """
    reachable = reachable_set(controller)
    beyond = np.zeros(len(forces), bool) if reachable is None else ~reachable.contains(forces)
    for x, y in forces[~beyond].tolist():
        controller.check((x, y))
    if reachable is None or not beyond.any():
        return forces
    low, high = reachable.bounds()
    cells = controller_cells(controller) or (Cell(low=low, high=high),)
    near = reachable.nearest_within(cells, forces[beyond])
    if np.isnan(near).any():
        x, y = forces[beyond][0].tolist()
        outside = (x, y)
        nearest_cell = min(cells, key=lambda cell: cell.distance(outside))
        x, y = reachable.nearest(outside).tolist()
        raise CoverageError(
            f"reference {format_force(outside)} N: this fin cannot make it, nor any other force "
            f"that this controller was trained for (nearest cell {nearest_cell}); the nearest that "
            f"the fin can make is ({x:.3f}, {y:.3f}) N; train it there, within the fin's reach "
            "(softfin map shows it)"
        )
    for x, y in near.tolist():
        controller.check((x, y))
    within = forces.astype(float)
    within[beyond] = near
    return within


def unreachable(reference: ForceVector, near: ForceVector) -> str:
    """Describe a reference that the fin cannot make, with the nearest one that it can."""
    return (
        f"reference {format_force(reference)} N: this fin cannot make it; the nearest "
        f"that it can make in this controller's range is ({near[0]:.3f}, {near[1]:.3f}) N"
    )
