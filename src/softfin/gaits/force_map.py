"""The force map of a fin: the mean forces that it can produce, with their gaits and Sobolev terms.

The folder of a map contains ``map.json`` (lattice, region, provenance) and ``weights.safetensors``
(gaits and their forces).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat
from scipy.ndimage import map_coordinates

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, PlantError, one_line
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity, matches_identity
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Cell, Reachable, directions
from softfin.gaits.search import GaitConfig, find_gaits
from softfin.gaits.simulate import ReportSearch, Survey, SurveyConfig, missing_gradient, survey
from softfin.gaits.usable import check_usable
from softfin.storage import artifact as artifacts

MAP_KIND = "map"

TOLERANCE_N = 0.1
"""Force error up to which a force counts as reachable, for the paper's fin [N]."""

RAY_PARTS = 24
"""Number of points along the ray to each corner at which the error is interpolated."""

NOT_STAR = 0.05
"""Fraction of nodes on the wrong side of the edge above which a region is not considered
star-shaped. A few nodes are always too close to the edge to tell."""


class MapConfig(Configuration):
    """Configuration of a force map."""

    box: Cell | None = None
    """Range of the mapped forces [N]; null for the bounding box of all forces found by the
    survey."""
    nodes: int = Field(default=120, ge=4)
    """Approximate number of nodes of the lattice before it is halved (`gaits.halvings`)."""
    spacing_n: PositiveFloat | None = None
    """Maximum distance between nodes of the lattice [N] before it is halved; null to derive it from
    `nodes`."""
    tolerance_n: PositiveFloat | None = None
    """Maximum force error of a gait whose force counts as reachable [N]; null for `TOLERANCE_N`,
    scaled by the size of the fin."""
    clock: ActionClock = PAPER_CLOCK
    """Clock of the actions; a gait lasts one of its windows."""
    survey: SurveyConfig = SurveyConfig()
    """Configuration of the survey, which precedes the search for gaits."""
    gaits: GaitConfig = GaitConfig()
    """Configuration of the search for gaits."""

    def empty_table(self, surveyed: Reachable) -> GaitTable:
        """Return an empty table over the box or the surveyed region, with the spacing before any
        halving."""
        box = self.box or surveyed.bounding_box()
        width, height = np.subtract(box.high, box.low).tolist()
        # Squares of this size cover the box. A box without an area has nodes along its length.
        spacing_n = self.spacing_n or max(
            (width * height / self.nodes) ** 0.5, max(width, height) / self.nodes, 1e-9
        )
        return GaitTable.over(box, spacing_n, self.clock.window_actions)

    def tolerance(self, surveyed: Reachable) -> float:
        """Return the maximum force error of a gait whose force counts as reachable [N]."""
        return self.tolerance_n or TOLERANCE_N * surveyed.size


def empty_map(table: GaitTable, directions: int, clock: ActionClock) -> ForceMap:
    """Return an empty map with the shapes of a checkpoint."""
    nothing = np.zeros((*table.nodes, 2), np.float32)
    nowhere = Reachable(np.zeros(2, np.float32), np.zeros(directions, np.float32))
    return ForceMap(GaitSearchResult(table, nothing, nothing), nowhere, clock)


def find_force_map(
    plant: Plant,
    config: MapConfig,
    report: ReportSearch | None = None,
    surveyed: Survey | None = None,
) -> ForceMap:
    """Survey a plant, unless that is done, find a gait for each node, and determine the region that
    the gaits reach.

    Raises:
        PlantError: the plant has no gradient, or its forces cannot be controlled.
    """
    if (reason := missing_gradient(plant)) is not None:
        raise PlantError(
            "map: the mean force of this plant has no gradient with respect to its commands, which "
            f"the search for gaits requires: {reason}; record the plant (softfin collect), fit a "
            "surrogate (softfin fit), and map the surrogate"
        )
    notify = report or (lambda *_: None)
    start = 0.0
    if surveyed is None:
        # The survey takes about 30% of the progress bar.
        start = 0.3
        surveyed = survey(
            plant, config.survey, lambda done, note: notify(start * done, note), config.clock
        )
    check_usable(plant, surveyed.reachable)
    empty = config.empty_table(surveyed.reachable)
    gaits = find_gaits(
        plant,
        surveyed,
        empty,
        config.gaits,
        lambda done, note: notify(start + (1 - start) * done, note),
    )
    tolerance_n = config.tolerance(surveyed.reachable)
    region = held_region(surveyed.reachable, gaits, tolerance_n)
    return ForceMap(gaits, region, config.clock)


def held_region(surveyed: Reachable, gaits: GaitSearchResult, tolerance_n: float) -> Reachable:
    """Shorten each ray of a region to the point where the interpolated force error exceeds the
    tolerance.

    A node outside the reachable region has the gait of the nearest reachable force, so its error
    increases with the distance to the edge and can be interpolated. Outside the lattice the error
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


def check_star(force_map: ForceMap, tolerance_n: float) -> tuple[dict[str, float], str | None]:
    """Check whether the reachable forces of a map are star-shaped, as its region assumes.

    Returns:
        ``held_outside``, the fraction of nodes with an accurate gait that are clearly outside the
        region, and ``missed_inside``, the fraction of nodes in the region without an accurate gait;
        and a warning if one of them is large.
    """
    region = force_map.reachable
    nodes = force_map.gaits.table.references().reshape(-1, 2)
    held = force_map.gaits.force_error().reshape(-1) <= tolerance_n
    # A ray ends at its last accurate point, which may be one part short of the edge.
    margin_n = tolerance_n + float(np.max(region.radius)) / RAY_PARTS
    clearly_outside = ~region.contains(nodes, margin_n)
    inside = region.contains(nodes)
    outside = float((held & clearly_outside).sum() / max(held.sum(), 1))
    unmet = float((inside & ~held).sum() / max(inside.sum(), 1))
    warning = (
        "map: the region is stored as star-shaped about its centre, but that of this fin is not: "
        f"{outside:.0%} of the forces that gaits produce are outside the stored region, and no "
        f"gait was found for {unmet:.0%} of the forces inside it"
    )
    star = {"held_outside": outside, "missed_inside": unmet}
    return star, warning if max(outside, unmet) > NOT_STAR else None


class LoadedMap(NamedTuple):
    """Content of the folder of a map."""

    force_map: ForceMap
    limits: Limits
    """Command limits of the plant; actions of the gaits are relative to them."""
    config: MapConfig
    """Configuration of the map."""
    plant_identity: str | None
    """Identity of the plant, if known."""


def save_map(
    path: Path,
    force_map: ForceMap,
    config: MapConfig,
    limits: Limits,
    origin: JsonObject,
    overwrite: bool = False,
) -> None:
    """Write a map and its figure, ``map.svg`` and ``map.png``, completely or not at all."""
    # Imported here, because importing Matplotlib takes time and reading a map does not need it.
    from softfin.gaits.figure import map_figure
    from softfin.storage.figures import save_figure

    tolerance_n = config.tolerance(force_map.reachable)
    description = {
        "limits": limits.to_dict(),
        **force_map.to_dict(),
        "star_shape": check_star(force_map, tolerance_n)[0],
        "configuration": config.model_dump(mode="json"),
        "provenance": origin,
    }
    figure = map_figure(force_map, tolerance_n)
    arrays = force_map.arrays()

    def draw(folder: Path) -> None:
        save_figure(figure, folder, "map")

    artifacts.save(path, MAP_KIND, description, arrays, draw, overwrite)


def load_map(path: Path) -> LoadedMap:
    """Load the map in a folder; raises ArtifactError if it is missing or damaged."""
    description, weights = artifacts.load(path, MAP_KIND)
    source = str(path / f"{MAP_KIND}.json")
    try:
        return LoadedMap(
            ForceMap.from_dict(description, weights),
            Limits.of(description["limits"]),
            MapConfig.model_validate(description["configuration"]),
            description["provenance"].get("plant_identity"),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArtifactError(
            f"{source}: invalid map ({one_line(error)}); run softfin map again"
        ) from None


def load_force_map(path: Path, plant: Plant, name: str) -> LoadedMap:
    """Load a map and check that it belongs to a plant.

    The actions of gaits are relative to the limits of the plant, and other plants would produce
    other forces from them. `name` is the name of the plant in error messages.

    Raises:
        ArtifactError: the map is missing or damaged, or belongs to another plant.
    """
    loaded = load_map(path)
    limits = list(map(float, plant.limits))
    same_limits = np.allclose(loaded.limits, limits, atol=1e-3)
    if not same_limits or not matches_identity(loaded.plant_identity, plant):
        raise ArtifactError(
            f"{path}: the map belongs to another plant ({loaded.plant_identity}) or to other "
            f"limits than those of {name} ({identity(plant)}); map this plant: softfin map {name} "
            "--out DIR"
        )
    return loaded
