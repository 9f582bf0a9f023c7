"""Which references a controller takes: the cells that it was trained for, and what the fin can do within them."""

from collections.abc import Sequence

from softfin.control.controller import Controller
from softfin.errors import CoverageError
from softfin.tracking.reachable import Reachable
from softfin.tracking.references import Cell, Force


def check_within(cells: Sequence[Cell], reference: Force) -> None:
    """Raise CoverageError outside every cell."""
    nearest = min(cells, key=lambda cell: cell.distance(reference))
    beyond = nearest.distance(reference)
    if beyond > 0:
        which = f"the nearest of {len(cells)} cells" if len(cells) > 1 else "what this controller was trained for"
        raise CoverageError(
            f"reference ({reference[0]:g}, {reference[1]:g}) N: {beyond:.2g} N outside {which} ({nearest}); "
            f"ask within {'a cell' if len(cells) > 1 else 'it'}, or train with {'a' if len(cells) > 1 else 'a wider'} "
            "cell there"
        )


def admitted(controller: Controller, reference: Force, strict: bool) -> tuple[Force, str | None]:
    """The reference to hold, and a warning where it is another: the nearest force that the fin can make.

    Raises CoverageError where the fin cannot make the reference and `strict`, or where the controller was not trained
    for it.
    """
    reachable: Reachable | None = getattr(controller, "reachable", None)
    if reachable is None or reachable.contains(reference):
        controller.check(reference)
        return reference, None
    x, y = reachable.nearest(reference)
    said = f"reference ({reference[0]:g}, {reference[1]:g}) N: this fin cannot make it; the nearest that it can make is"
    if strict:
        raise CoverageError(f"{said} ({x:.3f}, {y:.3f}) N; ask for that, or leave out --strict")
    controller.check((x, y))
    return (x, y), f"{said} ({x:.3f}, {y:.3f}) N, which is held instead"
