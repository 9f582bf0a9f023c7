"""Which forces a fin can make, many at once, and the nearest one to a force that lies within some cells, too."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from softfin.gaits.reachable import Reachable
from softfin.task.references import Cell

Forces = Float[np.ndarray, "forces 2"]

TOLERANCE_N = 1e-3
"""Forces this near to the edge of the reach count as reached, as in `Reachable.contains`."""

CHUNK = 2048
"""Forces that are looked at together, which bounds the memory."""

_pulled = jax.jit(jax.vmap(Reachable.pulled, in_axes=(None, 0)))


def reached(reachable: Reachable, forces: Forces) -> Bool[np.ndarray, "forces"]:
    """Of each force whether the fin can make it."""
    at = forces.astype(np.float32)
    return np.asarray(np.abs(np.asarray(_pulled(reachable, at)) - at).max(axis=1) <= TOLERANCE_N)


def nearest_within(reachable: Reachable, cells: Sequence[Cell], forces: Forces) -> Forces:
    """To each force the nearest one that the fin can make and that a cell holds; NaN where there is none."""
    parts = [forces[start : start + CHUNK] for start in range(0, len(forces), CHUNK)]
    return np.concatenate([_nearest(reachable, cells, part.astype(float)) for part in parts])


def _nearest(reachable: Reachable, cells: Sequence[Cell], forces: Forces) -> Forces:
    best, least = np.full(forces.shape, np.nan), np.full(len(forces), np.inf)
    for cell in cells:
        for candidates in (_on_box(reachable, cell, forces), _on_edge(reachable, cell, forces)):
            distance = np.hypot(*np.moveaxis(candidates - forces[:, None], -1, 0))
            distance = np.where(np.isnan(distance), np.inf, distance)
            chosen = distance.argmin(axis=1)[:, None]
            nearer = np.take_along_axis(distance, chosen, axis=1)[:, 0]
            found = np.take_along_axis(candidates, chosen[..., None], axis=1)[:, 0]
            best = np.where((nearer < least)[:, None], found, best)
            least = np.minimum(nearer, least)
    return best


def _on_box(reachable: Reachable, cell: Cell, forces: Forces) -> Float[np.ndarray, "forces candidates 2"]:
    """The nearest force of the cell, of each of its sides, and its corners; NaN for those beyond the reach.

    Where the nearest force of both regions is on a side of the cell, it is one of these or on the edge of the reach.
    """
    (x0, y0), (x1, y1) = cell.low, cell.high
    x, y = np.clip(forces, cell.low, cell.high).T
    each = [(x, y)]
    each += [(np.full_like(x, side), y) for side in (x0, x1)] + [(x, np.full_like(y, side)) for side in (y0, y1)]
    each += [(np.full_like(x, a), np.full_like(y, b)) for a in (x0, x1) for b in (y0, y1)]
    candidates = np.stack([np.stack(pair, axis=1) for pair in each], axis=1)
    inside = reached(reachable, candidates.reshape(-1, 2)).reshape(candidates.shape[:2])
    return np.where(inside[..., None], candidates, np.nan)


def _on_edge(reachable: Reachable, cell: Cell, forces: Forces) -> Float[np.ndarray, "forces candidates 2"]:
    """The nearest force of each side of the reach, as far as that side lies in the cell; NaN for the others."""
    corners = reachable.corners().astype(float)
    side = np.roll(corners, -1, axis=0) - corners
    # Where each side enters and leaves the cell, as a part of its length (Liang and Barsky 1984).
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.stack([(np.asarray(bound) - corners) / side for bound in (cell.low, cell.high)])
    between = (corners >= cell.low) & (corners <= cell.high)
    enter = np.where(side == 0, np.where(between, 0, np.inf), crossings.min(axis=0)).max(axis=1).clip(0)
    leave = np.where(side == 0, np.where(between, 1, -np.inf), crossings.max(axis=0)).min(axis=1).clip(max=1)
    along = ((forces[:, None] - corners) * side).sum(axis=-1) / np.maximum((side**2).sum(axis=-1), 1e-12)
    on_side = corners + np.clip(along, enter, np.maximum(enter, leave))[..., None] * side
    # Rounding must not lead out of the cell.
    return np.where((enter <= leave)[:, None], np.clip(on_side, cell.low, cell.high), np.nan)
