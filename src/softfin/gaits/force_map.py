"""The force map of a fin: the mean forces that it can make, their Sobolev terms, and the gaits that
make them.

Its folder holds ``map.json`` (lattice, region, provenance) and ``weights.safetensors`` (gaits,
their forces).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat
from scipy.ndimage import map_coordinates

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError, PlantError, one_line
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity, matches_identity
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Cell, Reachable, directions
from softfin.gaits.search import GaitConfig, find_gaits
from softfin.gaits.simulate import ReportSearch, SurveyConfig, missing_gradient, survey
from softfin.storage import artifact as artifacts

MAP_KIND = "map"

RAY_PARTS = 24
"""Places along the ray to each corner at which the error is interpolated."""

NOT_STAR = 0.05
"""Fraction from which on a region counts as not star-shaped: a node or two lie on its edge
anyway."""


class MapConfig(Configuration):
    """Configuration of a force map."""

    box: Cell | None = None
    """Forces that are mapped [N]; none: all that the survey reached, rounded outwards to whole
    spacings."""
    spacing_n: PositiveFloat = 0.5
    """Greatest distance between nodes of the lattice [N] before it is halved (`gaits.halvings`)."""
    tolerance_n: float = Field(default=0.1, gt=0)
    """Force error up to which a force counts as reachable [N]."""
    survey: SurveyConfig = SurveyConfig()
    """Configuration of the survey, which comes first."""
    gaits: GaitConfig = GaitConfig()
    """Configuration of the search for the lattice's gaits."""

    def empty_table(self, surveyed: Reachable) -> GaitTable:
        """Return a table without gaits over the box or the surveyed region, with the spacing before
        any halving."""
        box = self.box
        if box is None:
            low, high = np.asarray(surveyed.bounds()) / self.spacing_n
            low = np.floor(low) * self.spacing_n
            high = np.ceil(high) * self.spacing_n
            box = Cell(low=tuple(low.tolist()), high=tuple(high.tolist()))
        return GaitTable.over(box, self.spacing_n)


def empty_map(table: GaitTable, directions: int) -> ForceMap:
    """Return a map of the right shapes, to load a checkpoint into."""
    nothing = np.zeros((*table.nodes, 2), np.float32)
    nowhere = Reachable(np.zeros(2, np.float32), np.zeros(directions, np.float32))
    return ForceMap(GaitSearchResult(table, nothing, nothing), nowhere)


def find_force_map(plant: Plant, config: MapConfig, report: ReportSearch | None = None) -> ForceMap:
    """Survey a plant, search a gait for every node, and determine how far the gaits reach."""
    if (reason := missing_gradient(plant)) is not None:
        raise PlantError(
            "map: the mean force of this plant has no slope against its commands, which the "
            f"search for gaits follows: {reason}; record it (softfin collect), fit a surrogate "
            "(softfin fit) and map that"
        )
    told = report or (lambda *_: None)
    surveyed = survey(plant, config.survey, lambda done, note: told(0.3 * done, note))
    empty = config.empty_table(surveyed.reachable)
    gaits = find_gaits(
        plant, surveyed, empty, config.gaits, lambda done, note: told(0.3 + 0.7 * done, note)
    )
    return ForceMap(gaits, held_region(surveyed.reachable, gaits, config.tolerance_n))


def held_region(surveyed: Reachable, gaits: GaitSearchResult, tolerance_n: float) -> Reachable:
    """Shorten each ray of a region to where the force error of the nodes round it exceeds the
    tolerance.

    A node beyond the fin's reach makes the nearest force that the fin can make, so its error grows
    with the distance to the edge, and between the nodes it may be interpolated. Beyond the lattice,
    where it is 0, the survey's region is kept.
    """
    radius = np.asarray(surveyed.radius)
    low = np.asarray(gaits.table.low, float)
    high = np.asarray(gaits.table.high, float)
    parts = np.linspace(0, 1, RAY_PARTS + 1)[1:, None, None]
    force = np.asarray(surveyed.centre) + parts * (radius[:, None] * directions(len(radius)))
    place = (force - low) / np.maximum(high - low, 1e-9) * (np.array(gaits.table.nodes) - 1)
    error = map_coordinates(
        gaits.force_error(), np.moveaxis(place, -1, 0), float, order=1, mode="constant"
    )
    good = np.cumprod(error <= tolerance_n, axis=0).sum(axis=0)
    return surveyed._replace(
        radius=np.asarray(radius * np.maximum(good, 1) / RAY_PARTS, np.float32)
    )


def check_star(force_map: ForceMap, tolerance_n: float) -> tuple[dict[str, float], str | None]:
    """Compare the nodes of a map with its region: two fractions, and a warning where one of them is
    large.

    ``held_outside`` is the fraction of the nodes whose gaits make their force that lie clearly
    outside the region, ``missed_inside`` the fraction of the nodes within it whose gaits do not.
    """
    region = force_map.reachable
    nodes = force_map.gaits.table.references().reshape(-1, 2)
    held = force_map.gaits.force_error().reshape(-1) <= tolerance_n
    # A ray ends at the last of its parts that is held, which may be one part short of the edge.
    margin_n = tolerance_n + float(np.max(region.radius)) / RAY_PARTS
    clearly_outside = ~region.contains(nodes, margin_n)
    inside = region.contains(nodes)
    outside = float((held & clearly_outside).sum() / max(held.sum(), 1))
    unmet = float((inside & ~held).sum() / max(inside.sum(), 1))
    warning = (
        "the region is kept as star-shaped about its centre, which this fin's is not: "
        f"{outside:.0%} of the forces that gaits make lie outside it, and no gait was found for "
        f"{unmet:.0%} of the forces inside it"
    )
    star = {"held_outside": outside, "missed_inside": unmet}
    return star, warning if max(outside, unmet) > NOT_STAR else None


class LoadedMap(NamedTuple):
    """Content of a map's folder."""

    force_map: ForceMap
    limits: Limits
    """Limits of the gaits' commands."""
    config: MapConfig
    """Configuration that the map was made with."""
    plant_identity: str | None


def save_map(
    path: Path,
    force_map: ForceMap,
    config: MapConfig,
    limits: Limits,
    origin: JsonObject,
    overwrite: bool = False,
) -> None:
    """Write a map with its figure, ``map.svg`` and ``map.png``, whole or not at all."""
    # Who only reads maps need not wait for Matplotlib.
    from softfin.gaits.figure import map_figure
    from softfin.storage.figures import save_figure

    description = {
        "limits": limits.to_dict(),
        **force_map.to_dict(),
        "star_shape": check_star(force_map, config.tolerance_n)[0],
        "configuration": config.model_dump(mode="json"),
        "provenance": origin,
    }
    figure = map_figure(force_map, config.tolerance_n)
    arrays = force_map.arrays()

    def draw(folder: Path) -> None:
        save_figure(figure, folder, "map")

    artifacts.save(path, MAP_KIND, description, arrays, draw, overwrite)


def load_map(path: Path) -> LoadedMap:
    """Load the map in a folder; raises ArtifactError where there is none, or it is damaged."""
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
            f"{source}: not a valid map ({one_line(error)}); map it again"
        ) from None


def load_force_map(path: Path, plant: Plant, name: str) -> LoadedMap:
    """Load the map of a plant, which messages call `name`; raises ArtifactError where it is a map
    of another plant.

    Gaits are actions over the plant's limits, and another plant makes other forces of them.
    """
    loaded = load_map(path)
    limits = list(map(float, plant.limits))
    same_limits = np.allclose(loaded.limits, limits, atol=1e-3)
    if not same_limits or not matches_identity(loaded.plant_identity, plant):
        raise ArtifactError(
            f"{path}: a map of another plant ({loaded.plant_identity}) or for other limits than "
            f"{name} ({identity(plant)}) has now; map this one: softfin map {name} --out DIR"
        )
    return loaded
