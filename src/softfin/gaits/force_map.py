"""The force map of a fin: its reachable mean forces with their gaits and Sobolev terms."""

import numpy as np
from pydantic import Field, PositiveFloat
from scipy.ndimage import map_coordinates

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.configuration import Configuration
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, check_power
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Cell, Reachable, directions
from softfin.gaits.search import GaitConfig, find_gaits
from softfin.gaits.simulate import (
    POWER_VELOCITIES,
    ReportSearch,
    SurveyConfig,
    missing_gradient,
    simulate_gait_with_power,
    survey,
)
from softfin.gaits.usable import check_usable

TOLERANCE_N = 0.1
"""Maximum force error at which a force is treated as reachable, for the paper's fin [N]."""

SURVEY_SHARE = 0.3
"""Share of the progress bar used for the survey."""

RAY_PARTS = 24
"""Number of points along the ray to each corner of the region at which the error is
interpolated."""

NOT_STAR = 0.05
"""Fraction of nodes on the wrong side of the edge above which a region is not considered
star-shaped. A few nodes are always too close to the edge to be classified."""


class MapConfig(Configuration):
    """Configuration of a force map."""

    box: Cell | None = None
    """Range of the mapped forces [N]; null for the bounding box of all surveyed forces."""
    nodes: int = Field(default=120, ge=4)
    """Approximate number of lattice nodes before the spacing is halved (`gaits.halvings`)."""
    spacing_n: PositiveFloat | None = None
    """Maximum spacing of the lattice nodes before it is halved [N]; null to derive it from
    `nodes`."""
    clock: ActionClock = PAPER_CLOCK
    """Clock of the actions; a gait lasts one window of this clock."""
    survey: SurveyConfig = SurveyConfig()
    """Configuration of the survey, which precedes the search for gaits."""
    gaits: GaitConfig = GaitConfig()
    """Configuration of the search for gaits."""

    def empty_table(self, surveyed: Reachable) -> GaitTable:
        """Return an empty table over the box or the surveyed region, with the initial spacing."""
        box = self.box or surveyed.bounding_box()
        width, height = np.subtract(box.high, box.low).tolist()
        # Squares of this size cover the box. A box without an area has nodes along its length.
        spacing_n = self.spacing_n or max(
            (width * height / self.nodes) ** 0.5, max(width, height) / self.nodes, 1e-9
        )
        return GaitTable.over(box, spacing_n, self.clock.window_actions)


def force_tolerance(reachable: Reachable) -> float:
    """Return the maximum force error at which a force is treated as reachable [N]."""
    return TOLERANCE_N * reachable.size


def find_force_map(
    plant: Plant,
    config: MapConfig,
    report: ReportSearch = lambda *_: None,
) -> ForceMap:
    """Survey a plant, find a gait for each node, and determine the region reached by the gaits.

    Raises:
        PlantError: If the plant has no gradient, or its forces cannot be controlled.
    """
    if (reason := missing_gradient(plant)) is not None:
        raise PlantError(
            "map: the mean force of this plant has no gradient with respect to its commands, which "
            f"the search for gaits requires: {reason}; record the plant (softfin collect), fit a "
            "surrogate (softfin fit), and map the surrogate"
        )
    check_power(plant, config.gaits.power, "gaits.power")
    with_power = (simulate_gait_with_power, POWER_VELOCITIES) if config.gaits.power else ()
    surveyed = survey(
        plant,
        config.survey,
        lambda done, note: report(SURVEY_SHARE * done, note),
        config.clock,
        *with_power,
    )
    check_usable(plant, surveyed.reachable)
    empty = config.empty_table(surveyed.reachable)
    gaits = find_gaits(
        plant,
        surveyed,
        empty,
        config.gaits,
        lambda done, note: report(SURVEY_SHARE + (1 - SURVEY_SHARE) * done, note),
    )
    tolerance_n = force_tolerance(surveyed.reachable)
    region = held_region(surveyed.reachable, gaits, tolerance_n)
    return ForceMap(gaits, region, config.clock)


def held_region(surveyed: Reachable, gaits: GaitSearchResult, tolerance_n: float) -> Reachable:
    """Shorten each ray of a region to the point where the interpolated force error exceeds the
    tolerance.

    A node outside the reachable region has the gait of the nearest reachable force, so its error
    increases with the distance to the edge and can be interpolated. Outside the lattice, the error
    is set to 0, so the surveyed region is kept there.
    """
    radius = np.asarray(surveyed.radius)
    low = np.asarray(gaits.table.low, float)
    high = np.asarray(gaits.table.high, float)
    parts = np.linspace(0, 1, RAY_PARTS + 1)[1:, None, None]
    force = np.asarray(surveyed.centre) + parts * (radius[:, None] * directions(len(radius)))
    # In node units, (parts, corners, 2).
    place = (force - low) / np.maximum(high - low, 1e-9) * (np.array(gaits.table.nodes) - 1)
    error = map_coordinates(
        gaits.force_error(), np.moveaxis(place, -1, 0), float, order=1, mode="constant"
    )
    # Number of parts before the first one that exceeds the tolerance.
    good = np.cumprod(error <= tolerance_n, axis=0).sum(axis=0)
    return surveyed._replace(
        radius=np.asarray(radius * np.maximum(good, 1) / RAY_PARTS, np.float32)
    )


def star_warning(force_map: ForceMap, tolerance_n: float) -> str | None:
    """Return a warning if the reachable forces of a map are not star-shaped, as its region
    assumes."""
    region = force_map.reachable
    nodes = force_map.gaits.table.references().reshape(-1, 2)
    held = force_map.gaits.force_error().reshape(-1) <= tolerance_n
    # A ray ends at the last point within the tolerance, which may be one part short of the edge.
    margin_n = tolerance_n + float(np.max(region.radius)) / RAY_PARTS
    clearly_outside = ~region.contains(nodes, margin_n)
    inside = region.contains(nodes)
    outside = float((held & clearly_outside).sum() / max(held.sum(), 1))
    unmet = float((inside & ~held).sum() / max(inside.sum(), 1))
    if max(outside, unmet) <= NOT_STAR:
        return None
    return (
        "map: the region is stored as star-shaped about its centre, but the region of this fin is "
        f"not: {outside:.0%} of the forces that gaits produce are outside the stored region, and "
        f"no gait was found for {unmet:.0%} of the forces inside it"
    )
