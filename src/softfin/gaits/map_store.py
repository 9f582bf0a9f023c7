"""A force map's folder: ``map.json`` (lattice, region, provenance), ``weights.safetensors`` (gaits, their forces)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softfin.core.errors import ArtifactError
from softfin.core.plant import Plant
from softfin.core.plant_identity import identity
from softfin.core.quantities import Limits
from softfin.gaits.force_map import MapConfig, check_star
from softfin.gaits.gait import ForceMap
from softfin.storage import artifact as artifacts

KIND = "map"
FORMAT = 1


class LoadedMap(NamedTuple):
    """Content of a map's folder."""

    force_map: ForceMap
    limits: Limits
    """Limits of the gaits' commands."""
    config: MapConfig
    """Configuration that the map was made with."""
    plant_identity: str | None
    """Identity of the plant that was mapped."""


def save_map(
    path: Path,
    force_map: ForceMap,
    config: MapConfig,
    limits: Limits,
    provenance: dict[str, Any],
    extra_files: Callable[[Path], None] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a map, whole or not at all; `extra_files` adds to the folder."""
    description = {
        "kind": KIND, "format": FORMAT,
        "limits": limits.to_dict(),
        **force_map.to_dict(),
        "star_shape": check_star(force_map, config.tolerance_n)._asdict(),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }  # fmt: skip
    artifacts.save(path, KIND, description, force_map.arrays(), extra_files, overwrite)


def load_map(path: Path) -> LoadedMap:
    """Load the map in a folder; raises ArtifactError where there is none, or it is damaged."""
    description, weights = artifacts.load(path, KIND)
    source = str(path / f"{KIND}.json")
    if description.get("format") != FORMAT:
        raise ArtifactError(f"{source}: format {description.get('format')}; this softfin reads {FORMAT}; update it")
    try:
        return LoadedMap(
            ForceMap.from_dict(description, weights),
            Limits.of(description["limits"]),
            MapConfig.model_validate(description["configuration"]),
            description["provenance"].get("plant_identity"),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ArtifactError(f"{source}: not a map's description ({' '.join(str(error).split())})") from None


def load_force_map(path: Path, plant: Plant, name: str) -> LoadedMap:
    """Load the map of a plant, which messages call `name`; raises ArtifactError where it is a map of another plant.

    Gaits are actions over the plant's limits, and another plant makes other forces of them.
    """
    loaded = load_map(path)
    if loaded.plant_identity != identity(plant):
        raise ArtifactError(
            f"{path}: a map of another plant ({loaded.plant_identity}) than {name} ({identity(plant)}); map this one: "
            f"softfin map {name} --out DIR"
        )
    if not np.allclose(loaded.limits, [float(limit) for limit in plant.limits], atol=1e-3):
        raise ArtifactError(
            f"{path}: a map for other limits than {name} has now; map it again: softfin map {name} --out DIR"
        )
    return loaded
