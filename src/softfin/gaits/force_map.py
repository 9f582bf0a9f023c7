"""The force map of a fin: the mean forces that it can make, their Sobolev terms, and the gaits that make them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from scipy.ndimage import map_coordinates

from softfin.core.configuration import Configuration
from softfin.core.errors import PlantError
from softfin.core.plant import Plant
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Cell, Reachable, directions
from softfin.gaits.search import GaitConfig, find_gaits
from softfin.gaits.simulate import missing_gradient
from softfin.gaits.survey import SurveyConfig, survey

PARTS = 24
"""Places along the ray to each corner at which the error is interpolated."""


class MapConfig(Configuration):
    """Configuration of a force map."""

    box: Cell | None = None
    """Forces that are mapped [N]; none: all that the survey reached, rounded outwards to whole spacings."""
    spacing_n: PositiveFloat = 0.5
    """Greatest distance between nodes of the lattice [N]."""
    tolerance_n: float = Field(default=0.1, gt=0)
    """Force error up to which a force counts as reachable [N]."""
    survey: SurveyConfig = SurveyConfig()
    """Configuration of the survey, which comes first."""
    gaits: GaitConfig = GaitConfig()
    """Configuration of the search for the lattice's gaits."""

    def empty_table(self, surveyed: Reachable) -> GaitTable:
        """Return a table without gaits over the box, or over the region that was surveyed."""
        if self.box is not None:
            return GaitTable.over(self.box, self.spacing_n)
        low, high = (np.asarray(corner) / self.spacing_n for corner in surveyed.bounds())
        low, high = np.floor(low) * self.spacing_n, np.ceil(high) * self.spacing_n
        return GaitTable.over(Cell(low=tuple(low.tolist()), high=tuple(high.tolist())), self.spacing_n)


def empty_map(table: GaitTable, directions: int) -> ForceMap:
    """Return a map of the right shapes, to load a checkpoint into."""
    nothing = np.zeros((*table.nodes, 2), np.float32)
    nowhere = Reachable(np.zeros(2, np.float32), np.zeros(directions, np.float32))
    return ForceMap(GaitSearchResult(table, nothing, nothing), nowhere)


def map_forces(plant: Plant, config: MapConfig, report: Callable[[float, str], None] | None = None) -> ForceMap:
    """Survey a plant, search a gait for every node, and determine how far the gaits reach."""
    if (reason := missing_gradient(plant)) is not None:
        raise PlantError(
            "map: the mean force of this plant has no slope against its commands, which the search for gaits follows: "
            f"{reason}; record it (softfin collect), fit a surrogate (softfin fit) and map that"
        )

    def part(begin: float, end: float) -> Callable[[float, str], None] | None:
        return None if report is None else lambda done, note: report(begin + (end - begin) * done, note)

    surveyed = survey(plant, config.survey, part(0.0, 0.3))
    gaits = find_gaits(plant, surveyed, config.empty_table(surveyed.reachable), config.gaits, part(0.3, 1.0))
    return ForceMap(gaits, held_region(surveyed.reachable, gaits, config.tolerance_n))


def held_region(surveyed: Reachable, gaits: GaitSearchResult, tolerance_n: float) -> Reachable:
    """Shorten each ray of a region to where the force error of the nodes round it exceeds the tolerance.

    A node beyond the fin's reach makes the nearest force that the fin can make, so its error grows with the distance to
    the edge, and between the nodes it may be interpolated. Beyond the lattice the survey's region is kept. Where no
    gait makes the force at the centre, as inside a ring, the node from which the largest region is held replaces it.
    """
    centre = np.asarray(surveyed.centre)
    if _interpolated_error(gaits, centre[None, None])[0, 0] > tolerance_n:
        nodes = gaits.table.references()[gaits.force_error() <= tolerance_n]
        others = [_held_from(node, surveyed, gaits, tolerance_n) for node in nodes[surveyed.contains(nodes)]]
        if others:
            return max(others, key=Reachable.area)
    return _held_from(centre, surveyed, gaits, tolerance_n)


def _held_from(
    centre: Float[np.ndarray, "2"], surveyed: Reachable, gaits: GaitSearchResult, tolerance_n: float
) -> Reachable:
    radius = surveyed.distances_from(centre)
    parts = np.linspace(0, 1, PARTS + 1)[1:, None, None]
    error = _interpolated_error(gaits, centre + parts * (radius[:, None] * directions(len(radius))))
    good = np.cumprod(error <= tolerance_n, axis=0).sum(axis=0)
    return Reachable(centre, np.asarray(radius * np.maximum(good, 1) / PARTS, np.float32))


class StarCheck(NamedTuple):
    """How far the forces that gaits make are from filling the star-shaped region that stands for them."""

    held_outside: float
    """Fraction of the nodes whose gaits make their force that lie clearly outside the region."""
    missed_inside: float
    """Fraction of the nodes within the region whose gaits do not make their force."""

    @property
    def warning(self) -> str | None:
        """Warning in a sentence; None where both fractions are small."""
        if max(self) <= NOT_STAR:
            return None
        return (
            "the region is kept as star-shaped about its centre, which this fin's is not: "
            f"{self.held_outside:.0%} of the forces that gaits make lie outside it, and no gait was found for "
            f"{self.missed_inside:.0%} of the forces inside it"
        )


NOT_STAR = 0.05
"""Fraction from which on a region counts as not star-shaped: a node or two lie on its edge anyway."""


def check_star(force_map: ForceMap, tolerance_n: float) -> StarCheck:
    """Compare the nodes of a map with its region."""
    region, nodes = force_map.reachable, force_map.gaits.table.references().reshape(-1, 2)
    held = force_map.gaits.force_error().reshape(-1) <= tolerance_n
    # A ray ends at the last of its parts that is held, which may be one part short of the edge.
    clearly_outside = ~region.contains(nodes, tolerance_n + float(np.max(region.radius)) / PARTS)
    inside = region.contains(nodes)
    return StarCheck(
        float((held & clearly_outside).sum() / max(held.sum(), 1)), float((inside & ~held).sum() / max(inside.sum(), 1))
    )


def _interpolated_error(
    gaits: GaitSearchResult, force: Float[np.ndarray, "parts directions 2"]
) -> Float[np.ndarray, "parts directions"]:
    """Interpolate the nodes' force error bilinearly; 0 beyond the lattice."""
    low, width = np.asarray(gaits.table.low, float), np.ptp([gaits.table.low, gaits.table.high], axis=0)
    place = (force - low) / np.maximum(width, 1e-9) * (np.array(gaits.table.nodes) - 1)
    error = map_coordinates(gaits.force_error(), np.moveaxis(place, -1, 0), float, order=1, mode="constant")
    return np.asarray(error)
