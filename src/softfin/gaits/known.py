"""A map from its folder as what is known of a plant: only of the very plant that it was made of."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfin.core.errors import ArtifactError
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.gaits.force_map import ForceMap, MapConfig
from softfin.gaits.map_store import KIND, load_map
from softfin.storage import artifact as artifacts


class Known(NamedTuple):
    """What a map's folder holds."""

    found: ForceMap
    config: MapConfig
    """How it was made."""


def known_of(path: Path, plant: Plant, named: str) -> Known:
    """The map in a folder; raises ArtifactError where it is none, or one of another plant than that which is `named`.

    Gaits are actions over the plant's limits, and what one plant makes of them another does not.
    """
    found, limits = load_map(path)
    description = artifacts.load_description(path, KIND)
    made_of = description.get("provenance", {}).get("plant_identity")
    if made_of != identity(plant):
        raise ArtifactError(
            f"{path}: a map of another plant ({made_of}) than {named} ({identity(plant)}); map this one: softfin map "
            f"{named} --out DIR"
        )
    if not np.allclose(limits, [float(limit) for limit in plant.limits], atol=1e-3):
        raise ArtifactError(
            f"{path}: a map for other limits than {named} has now; map it again: softfin map {named} --out DIR"
        )
    return Known(found, MapConfig.build(description["configuration"], str(path / f"{KIND}.json")))
