"""Which references a controller covers and its fin can make, so that experiments can be laid out within them."""

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller
from softfin.errors import CoverageError
from softfin.tracking.reachable import Reachable
from softfin.tracking.references import PAPER_RANGE, Cell, Force, least_box


def bounds(controller: Controller) -> Cell:
    """The least box round all cells of a controller; of one that has none, and covers everything, the paper's range."""
    cells: tuple[Cell, ...] = getattr(controller, "cells", None) or (getattr(controller, "cell", PAPER_RANGE),)
    return least_box(cells)


def reachable_of(controller: Controller) -> Reachable | None:
    """The mean forces that the fin can make, where the controller knows them."""
    reachable: Reachable | None = getattr(controller, "reachable", None)
    return reachable


def covers(controller: Controller, reference: Force) -> bool:
    """Whether the controller was trained for a reference."""
    try:
        controller.check(reference)
    except CoverageError:
        return False
    return True


def check_series(controller: Controller, references: Float[np.ndarray, "ticks 2"]) -> None:
    """Raise CoverageError unless the controller covers every reference of a series."""
    for x, y in np.unique(references, axis=0).tolist():
        controller.check((x, y))
