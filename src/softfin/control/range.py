"""Which references a controller takes: the cells that it was trained for, and what the fin can do within them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller
from softfin.core.errors import CoverageError
from softfin.gaits.nearest import nearest_within, reached
from softfin.gaits.reachable import Reachable
from softfin.task.references import Cell, Force

EDGE_N = 1e-4
"""References this near to a cell are on its edge: forces are float32, and their decimals seldom come out even."""


def cells_of(controller: Controller) -> tuple[Cell, ...]:
    """Those that it was trained for; none where it does not say, as one that covers everything."""
    cells: tuple[Cell, ...] = getattr(controller, "cells", None) or ()
    cell: Cell | None = getattr(controller, "cell", None)
    return cells or (() if cell is None else (cell,))


def reachable_of(controller: Controller) -> Reachable | None:
    """The mean forces that the fin can make, where the controller knows them."""
    reachable: Reachable | None = getattr(controller, "reachable", None)
    return reachable


def check_within(cells: Sequence[Cell], reference: Force) -> None:
    """Raise CoverageError outside every cell."""
    nearest = min(cells, key=lambda cell: cell.distance(reference))
    beyond = nearest.distance(reference)
    if beyond > EDGE_N:
        which = f"the nearest of {len(cells)} cells" if len(cells) > 1 else "what this controller was trained for"
        raise CoverageError(
            f"reference ({reference[0]:g}, {reference[1]:g}) N: {beyond:.2g} N outside {which} ({nearest}); "
            f"ask within {'a cell' if len(cells) > 1 else 'it'}, or train with {'a' if len(cells) > 1 else 'a wider'} "
            "cell there"
        )


def admitted(controller: Controller, reference: Force, strict: bool) -> tuple[Force, str | None]:
    """The reference to hold, and a warning where it is another: the nearest force that the fin can make.

    That force lies in the controller's cells. Raises CoverageError where the fin cannot make the reference and
    `strict`, or where the controller was not trained for it.
    """
    x, y = held(controller, np.array([reference], float))[0].tolist()
    # To the last bit it is what was asked for, unless it is another one.
    if (x, y) == tuple(reference):
        return reference, None
    said = beyond_reach(reference, (x, y))
    if strict:
        raise CoverageError(f"{said}; ask for that, or leave out --strict")
    return (x, y), f"{said}, which is held instead"


def beyond_reach(reference: Force, near: Force) -> str:
    """What is wrong with a reference, and the nearest one that is not."""
    return (
        f"reference ({reference[0]:g}, {reference[1]:g}) N: this fin cannot make it; the nearest that it can make "
        f"in this controller's range is ({near[0]:.3f}, {near[1]:.3f}) N"
    )


def held(controller: Controller, forces: Float[np.ndarray, "forces 2"]) -> Float[np.ndarray, "forces 2"]:
    """Each force, or where the fin cannot make it the nearest one that it can make in the controller's cells.

    Raises CoverageError for one that the fin can make but the controller was not trained for, and where the fin can
    make nothing that it was trained for.
    """
    reachable = reachable_of(controller)
    beyond = np.zeros(len(forces), bool) if reachable is None else ~reached(reachable, forces)
    for x, y in forces[~beyond].tolist():
        controller.check((x, y))
    if reachable is None or not beyond.any():
        return forces
    low, high = reachable.box()
    cells = cells_of(controller) or (Cell(low=low, high=high),)
    near = nearest_within(reachable, cells, forces[beyond])
    if np.isnan(near).any():
        raise CoverageError(_nothing(reachable, cells, forces[beyond][0]))
    for x, y in near.tolist():
        controller.check((x, y))
    within = forces.astype(float)
    within[beyond] = near
    return within


def _nothing(reachable: Reachable, cells: Sequence[Cell], force: Float[np.ndarray, "2"]) -> str:
    asked: Force = (float(force[0]), float(force[1]))
    x, y = reachable.nearest(asked)
    cell = min(cells, key=lambda each: each.distance(asked))
    return (
        f"reference ({asked[0]:g}, {asked[1]:g}) N: this fin cannot make it, nor any other force that this controller "
        f"was trained for (nearest cell {cell}); the nearest that the fin can make is ({x:.3f}, {y:.3f}) N; train it "
        "there, within the fin's reach (softfin map shows it)"
    )
