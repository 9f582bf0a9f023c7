"""References that a controller can hold: those within its cells that the fin can reach."""

import contextlib
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from softfin.core.errors import CoverageError
from softfin.gaits.reachable import (
    PAPER_REACH_N,
    PAPER_REFERENCES,
    Cell,
    Cells,
    Forces,
    ForceVector,
    Reachable,
    directions,
    force_decimals,
    format_force,
)

CELL_EDGE_FRACTION = 3e-5
"""References outside a cell by less than this fraction of its largest force are treated as on its
edge, because forces are rounded to float32."""


PATTERN_SCALES = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1])
"""Scale factors, relative to the natural size, at which the pattern of the paper's references is
tried."""

SPREAD = 0.6
"""Distance of the six references from the centre, as a fraction of the reach, if the paper's
pattern does not fit at any size."""


def default_references(
    reachable: Reachable | None, cells: Sequence[Cell] = ()
) -> tuple[ForceVector, ...]:
    """Return the six reference forces for evaluating a controller with these cells [N].

    These are the paper's references if the reach is unknown, if a fin of the paper's size can
    produce them, or if the controller was trained only for them. Otherwise, their pattern is scaled
    to the reach, and mirrored if necessary.
    """
    references = _scaled_references(reachable)
    if _covers(cells, references) or not _covers(cells, PAPER_REFERENCES):
        return references
    return PAPER_REFERENCES


def _covers(cells: Sequence[Cell], references: Sequence[ForceVector]) -> bool:
    with contextlib.suppress(CoverageError):
        for reference in references if cells else ():
            check_within(cells, reference)
        return True
    return False


def _scaled_references(reachable: Reachable | None) -> tuple[ForceVector, ...]:
    paper = np.array(PAPER_REFERENCES, float)
    if reachable is None or (reachable.size == 1 and reachable.contains(paper).all()):
        return PAPER_REFERENCES
    natural = reachable.reach_n / PAPER_REACH_N
    for scale in natural * PATTERN_SCALES:
        for way in (1, -1):
            pattern = _rounded(scale * way * paper, scale)
            if reachable.contains(pattern).all():
                return pattern
    around = reachable.centre + SPREAD * reachable.radius[:, None] * directions(
        len(reachable.radius)
    )
    spread = around[np.arange(6) * len(around) // 6]
    return _rounded(np.asarray(spread, float), natural)


def _rounded(forces: Forces, scale: float) -> tuple[ForceVector, ...]:
    """Round forces to a few percent of the scale, without -0."""
    decimals = max(force_decimals(scale) - 1, 0)
    return tuple((round(x, decimals) + 0.0, round(y, decimals) + 0.0) for x, y in forces.tolist())


def controller_cells(controller: object) -> Cells:
    """Return the cells for which a controller was trained; empty for a controller without `cells`,
    which covers every reference."""
    return cast(Cells, getattr(controller, "cells", None) or ())


def reachable_set(controller: object) -> Reachable | None:
    """Return the reachable mean forces of the controller fin, if known."""
    return cast(Reachable | None, getattr(controller, "reachable", None))


def check_within(cells: Sequence[Cell], reference: ForceVector) -> None:
    """Raise CoverageError if the reference [N] is outside every cell."""
    nearest = min(cells, key=lambda cell: cell.distance(reference))
    beyond = nearest.distance(reference)
    if beyond > CELL_EDGE_FRACTION * max(map(abs, (*nearest.low, *nearest.high))):
        which = "the range that this controller was trained for"
        fix = "use a reference within this range, or train a controller with a larger cell"
        if len(cells) > 1:
            which = f"the nearest of {len(cells)} cells"
            fix = "use a reference within a cell, or train a controller with a cell there"
        raise CoverageError(
            f"reference {format_force(reference)} N: {beyond:.2g} N outside {which} ({nearest}); "
            f"{fix}"
        )


def resolve_reference(
    controller: object, reference: ForceVector, strict: bool
) -> tuple[ForceVector, str | None]:
    """Return the reference to track, with a warning if it differs from the requested one.

    An unreachable reference is replaced by the nearest reachable force within the controller
    cells; with `strict`, it raises CoverageError instead. A reference for which the controller was
    not trained always raises CoverageError.
    """
    if not np.isfinite(reference).all():
        raise CoverageError(f"reference {format_force(reference)} N: must be two finite numbers")
    x, y = nearest_trackable(controller, np.array([reference], float))[0].tolist()
    # A reachable reference is returned unchanged to the last bit, so exact comparison is right.
    if (x, y) == tuple(reference):
        return reference, None
    problem = (
        f"reference {format_force(reference)} N: unreachable for this fin; the nearest reachable "
        f"force in the range of this controller is ({x:.3f}, {y:.3f}) N"
    )
    if strict:
        raise CoverageError(f"{problem}; use that force, or remove --strict")
    return (x, y), f"{problem}, which is tracked instead"


def nearest_trackable(controller: Any, forces: Forces) -> Forces:
    """Replace unreachable forces by the nearest reachable ones within the controller's cells.

    Raises CoverageError if the controller was not trained for a reachable force, or if it was
    trained for unreachable forces only.
    """
    reachable = reachable_set(controller)
    beyond = np.zeros(len(forces), bool) if reachable is None else ~reachable.contains(forces)
    for x, y in forces[~beyond].tolist():
        controller.check((x, y))
    if reachable is None or not beyond.any():
        return forces
    cells = controller_cells(controller) or (reachable.bounding_box(),)
    near = reachable.nearest_within(cells, forces[beyond])
    if np.isnan(near).any():
        x, y = forces[beyond][0].tolist()
        outside = (x, y)
        nearest_cell = min(cells, key=lambda cell: cell.distance(outside))
        x, y = reachable.nearest(outside).tolist()
        raise CoverageError(
            f"reference {format_force(outside)} N: this fin can produce neither this force nor any "
            f"other force that the controller was trained for (nearest cell {nearest_cell}); the "
            f"nearest reachable force is ({x:.3f}, {y:.3f}) N; train the controller for reachable "
            "forces (run softfin map to plot them)"
        )
    for x, y in near.tolist():
        controller.check((x, y))
    within = forces.astype(float)
    within[beyond] = near
    return within
