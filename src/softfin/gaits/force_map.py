"""The map of a fin: which mean forces it can make, at what Sobolev cost, and the gaits that make them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.core.errors import PlantError
from softfin.core.plant import Plant
from softfin.gaits.gaits import Found, GaitConfig, Lattice, find_gaits
from softfin.gaits.reachable import Reachable, directions
from softfin.gaits.simulate import missing_gradient
from softfin.gaits.survey import SurveyConfig, survey
from softfin.task.references import Cell

PARTS = 24
"""Places along the ray to each corner at which the map is read."""


class MapConfig(Configuration):
    """How a map is made."""

    box: Cell | None = None
    """Forces that are mapped [N]; none: all that the survey made, rounded outwards to whole spacings."""
    spacing_n: PositiveFloat = 0.5
    """Between the nodes of the lattice [N], at most."""
    tolerance_n: float = Field(default=0.1, gt=0)
    """A force counts as reachable where gaits come this near to it [N]."""
    survey: SurveyConfig = SurveyConfig()
    """What is tried first."""
    gaits: GaitConfig = GaitConfig()
    """How the gaits of the lattice are found."""

    def lattice(self, seen: Reachable) -> Lattice:
        """Over the box, or over what was seen."""
        if self.box is not None:
            return Lattice.over(self.box, self.spacing_n)
        low, high = (np.asarray(corner) / self.spacing_n for corner in seen.box())
        low, high = np.floor(low) * self.spacing_n, np.ceil(high) * self.spacing_n
        return Lattice.over(Cell(low=(float(low[0]), float(low[1])), high=(float(high[0]), float(high[1]))),
                            self.spacing_n)  # fmt: skip


class ForceMap(NamedTuple):
    """What a fin can do."""

    found: Found
    reachable: Reachable


def empty_map(lattice: Lattice, directions: int) -> ForceMap:
    """Of the shape of a map, to read one into."""
    nothing = np.zeros((*lattice.nodes, 2), np.float32)
    nowhere = Reachable(np.zeros(2, np.float32), np.zeros(directions, np.float32))
    return ForceMap(Found(lattice.table(), nothing, nothing), nowhere)


def map_forces(plant: Plant, config: MapConfig, report: Callable[[float, str], None] | None = None) -> ForceMap:
    """Survey a plant, find a gait for every node, and see how far they reach."""

    if (reason := missing_gradient(plant)) is not None:
        raise PlantError(
            "map: the mean force of this plant has no slope against its commands, which the search for gaits follows: "
            f"{reason}; record it (softfin collect), fit a surrogate (softfin fit) and map that"
        )

    def part(begin: float, end: float) -> Callable[[float, str], None] | None:
        return None if report is None else lambda done, note: report(begin + (end - begin) * done, note)

    seen = survey(plant, config.survey, part(0.0, 0.3))
    found = find_gaits(plant, seen, config.lattice(seen.reachable), config.gaits, part(0.3, 1.0))
    return ForceMap(found, reached(seen.reachable, found, config.tolerance_n))


def reached(seen: Reachable, found: Found, tolerance_n: float) -> Reachable:
    """What was seen, less what the gaits do not hold: each ray ends where the nodes round it miss by the tolerance.

    A node beyond the fin's reach makes the nearest force that the fin can make, so what it misses by grows with the
    distance to the edge, and between the nodes it may be interpolated. Beyond the lattice the survey's word is taken.
    Where no gait holds the centre, as inside a ring, the node from which most is held takes its place.
    """
    centre = np.asarray(seen.centre)
    if _interpolated(found, centre[None, None])[0, 0] > tolerance_n:
        nodes = found.table.references()[found.missed() <= tolerance_n]
        others = [_held_from(node, seen, found, tolerance_n) for node in nodes[_within(seen, nodes)]]
        if others:
            return max(others, key=Reachable.area)
    return _held_from(centre, seen, found, tolerance_n)


def _held_from(centre: Float[np.ndarray, "2"], seen: Reachable, found: Found, tolerance_n: float) -> Reachable:
    """How far the gaits hold along the rays from a centre to the edge of what was seen."""
    radius = seen.distances(centre)
    parts = np.linspace(0, 1, PARTS + 1)[1:, None, None]
    missed = _interpolated(found, centre + parts * (radius[:, None] * directions(len(radius))))
    good = np.cumprod(missed <= tolerance_n, axis=0).sum(axis=0)
    return Reachable(centre, np.asarray(radius * np.maximum(good, 1) / PARTS, np.float32))


class StarCheck(NamedTuple):
    """How far the forces that gaits hold are from filling a star-shaped region, as which they are kept."""

    held_outside: float
    """Share of the nodes whose gaits make their force that lie clearly outside the region."""
    missed_inside: float
    """Share of the nodes within the region whose gaits do not make their force."""

    @property
    def warning(self) -> str | None:
        """What is wrong, in a sentence; None where it is nothing to speak of."""
        found = []
        if self.held_outside > SPOILT:
            found.append(f"{self.held_outside:.0%} of the forces that gaits make lie outside it")
        if self.missed_inside > SPOILT:
            found.append(f"no gait was found for {self.missed_inside:.0%} of the forces inside it")
        if not found:
            return None
        return f"the region is kept as star-shaped about its centre, which this fin's is not: {' and '.join(found)}"


SPOILT = 0.05
"""Share from which on a region counts as not star-shaped: a node or two lie on its edge anyway."""


def check_star(known: ForceMap, tolerance_n: float) -> StarCheck:
    """Hold the nodes of a map against its region."""
    region, nodes = known.reachable, known.found.table.references().reshape(-1, 2)
    held = known.found.missed().reshape(-1) <= tolerance_n
    # A ray ends at the last of its parts that is held, which may be one part short of the edge.
    clearly_outside = ~_within(region, nodes, tolerance_n + float(np.max(region.radius)) / PARTS)
    inside = _within(region, nodes)
    return StarCheck(
        float((held & clearly_outside).sum() / max(held.sum(), 1)), float((inside & ~held).sum() / max(inside.sum(), 1))
    )


def _within(region: Reachable, forces: Float[np.ndarray, "n 2"], slack_n: float = 1e-3) -> Bool[np.ndarray, "n"]:
    pulled = jax.vmap(region.pulled)(jnp.asarray(forces))
    return np.asarray(np.linalg.norm(pulled - forces, axis=-1) <= slack_n)


def _interpolated(
    found: Found, force: Float[np.ndarray, "parts directions 2"]
) -> Float[np.ndarray, "parts directions"]:
    """What the nodes miss by, bilinear; 0 beyond the lattice."""
    missed, table = found.missed(), found.table
    low, high = np.asarray(table.low), np.asarray(table.high)
    last = np.array(missed.shape) - 1
    place = (force - low) / np.where(high > low, high - low, 1) * last
    beyond = ((force < low) | (force > high)).any(axis=-1)
    corner = np.clip(np.floor(place).astype(int), 0, last - 1)
    x, y = np.moveaxis(place - corner, -1, 0)
    i, j = np.moveaxis(corner, -1, 0)
    value = (missed[i, j] * (1 - x) * (1 - y) + missed[i + 1, j] * x * (1 - y)
             + missed[i, j + 1] * (1 - x) * y + missed[i + 1, j + 1] * x * y)  # fmt: skip
    within: Float[np.ndarray, "parts directions"] = np.where(beyond, 0, value)
    return within
