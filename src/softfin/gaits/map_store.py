"""A map's folder: ``map.json`` (lattice, region, provenance) and ``weights.safetensors`` (gaits and what they make)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.errors import ArtifactError
from softfin.core.quantities import Limits
from softfin.gaits.force_map import ForceMap, MapConfig, check_star
from softfin.gaits.gaits import Found, GaitTable
from softfin.gaits.reachable import Reachable
from softfin.storage import artifact as artifacts

KIND = "map"
FORMAT = 1


def save_map(
    path: Path,
    known: ForceMap,
    config: MapConfig,
    limits: Limits,
    provenance: dict[str, Any],
    also: Callable[[Path], None] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a map, whole or not at all; `also` adds files to the folder."""
    description = {
        "kind": KIND, "format": FORMAT,
        "limits": limits.described(),
        **described(known),
        "star_shape": check_star(known, config.tolerance_n)._asdict(),
        "configuration": config.model_dump(mode="json"),
        "provenance": provenance,
    }  # fmt: skip
    artifacts.save(path, KIND, description, arrays(known.found), also, overwrite)


def load_map(path: Path) -> tuple[ForceMap, Limits]:
    """The map in a folder and the limits of its commands; raises ArtifactError where it is none."""
    description, weights = artifacts.load(path, KIND)
    source = str(path / f"{KIND}.json")
    if description.get("format") != FORMAT:
        raise ArtifactError(f"{source}: format {description.get('format')}; this softfin reads {FORMAT}; update it")
    try:
        return ForceMap(found_of(description, weights), Reachable.of(description["reachable"])), Limits.of(
            description["limits"]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ArtifactError(f"{source}: not a map's description ({' '.join(str(error).split())})") from None


def described(known: ForceMap) -> dict[str, Any]:
    """Lattice and region, for JSON."""
    table = known.found.table
    return {
        "lattice": {
            "low_n": [float(x) for x in table.low],
            "high_n": [float(x) for x in table.high],
            "nodes": list(table.actions.shape[:2]),
        },
        "reachable": known.reachable.described(),
    }


def arrays(found: Found) -> dict[str, np.ndarray]:
    """By name."""
    return {"actions": np.asarray(found.table.actions), "force_n": found.force, "smoothness_n": found.smoothness}


def found_of(description: dict[str, Any], weights: dict[str, np.ndarray]) -> Found:
    """From what `described` and `arrays` gave; raises KeyError, TypeError, ValueError for anything else."""
    lattice = description["lattice"]
    nodes = tuple(int(count) for count in lattice["nodes"])
    actions, force, smoothness = (np.asarray(weights[n], np.float32) for n in ("actions", "force_n", "smoothness_n"))
    low, high = (np.asarray(lattice[name], np.float32) for name in ("low_n", "high_n"))
    if low.shape != (2,) or high.shape != (2,) or not (np.isfinite(low) & np.isfinite(high) & (low <= high)).all():
        raise ValueError(f"a lattice from {low.tolist()} to {high.tolist()} N is none")
    if len(nodes) != 2 or min(nodes) < 2:
        raise ValueError(f"a lattice of {nodes} nodes is none; it has two or more in x and in y")
    if actions.shape != (*nodes, CYCLE_ACTIONS, 2) or force.shape != (*nodes, 2) or smoothness.shape != force.shape:
        raise ValueError(f"gaits of shape {actions.shape} do not fit a lattice of {nodes}")
    if not all(np.isfinite(array).all() for array in (actions, force, smoothness)):
        raise ValueError("gaits are not finite")
    return Found(GaitTable(jnp.asarray(low), jnp.asarray(high), jnp.asarray(actions)), force, smoothness)
