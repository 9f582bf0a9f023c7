"""Which references a controller covers and its fin can make, so that experiments can be laid out within them."""

import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller
from softfin.control.references import cells_of, resolve_references, unreachable
from softfin.core.errors import CoverageError
from softfin.core.quantities import RATE_HZ
from softfin.gaits.reachable import Cell, Force, bounding_box
from softfin.task.references import PAPER_RANGE


def bounds(controller: Controller) -> Cell:
    """The least box round all cells of a controller; of one that has none, and covers everything, the paper's range."""
    return bounding_box(cells_of(controller) or (PAPER_RANGE,))


def covers(controller: Controller, reference: Force) -> bool:
    """Whether the controller was trained for a reference."""
    try:
        controller.check(reference)
    except CoverageError:
        return False
    return True


def admitted_series(
    controller: Controller, references: Float[np.ndarray, "ticks 2"], strict: bool, named: str
) -> tuple[Float[np.ndarray, "ticks 2"], str | None]:
    """The forces to hold, one a tick, and a warning where some are others: the nearest that the fin can make.

    Raises CoverageError unless the controller covers every force, or with `strict` for the first one beyond its reach.
    """
    distinct, places = np.unique(references, axis=0, return_inverse=True)
    near = resolve_references(controller, distinct).astype(np.float32)[places.reshape(-1)]
    distance = np.hypot(*(near - references).T)
    if not distance.any():
        return references, None
    first = int(np.argmax(distance > 0))
    if strict:
        (x, y), (a, b) = references[first].tolist(), near[first].tolist()
        raise CoverageError(
            f"{named}, at {first / RATE_HZ:g} s: {unreachable((x, y), (a, b))}; ask for that, or leave out --strict"
        )
    return near, (
        f"{named}: this fin cannot make what is asked in {np.count_nonzero(distance) / RATE_HZ:g} of "
        f"{len(references) / RATE_HZ:g} s, from {first / RATE_HZ:g} s on, by up to {distance.max():.3f} N; the nearest "
        "forces that it can make in this controller's range are held instead"
    )
