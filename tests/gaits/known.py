"""A force map with known numbers, and its folder."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from softfin.control.store import save_gaits
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Reachable

NUMBERS = np.random.default_rng(0)
TABLE = GaitTable(
    jnp.array([0.5, -1.0]),
    jnp.array([2.5, 2.0]),
    jnp.asarray(NUMBERS.uniform(-1, 1, (3, 4, 6, 2)), jnp.float32),
)
MADE = (TABLE.references() + 0.01).astype(np.float32)
KNOWN = ForceMap(
    GaitSearchResult(TABLE, MADE, NUMBERS.uniform(0, 1, (3, 4, 2)).astype(np.float32)),
    Reachable(np.array([1.5, 0.5], np.float32), np.linspace(1, 2, 12).astype(np.float32)),
)


def save_known(folder: Path, **keys: Any) -> Path:
    """Write it as a controller."""
    save_gaits(folder, KNOWN, 0.1, PAPER_LIMITS, {"provenance": {"plant": "mine"}, **keys})
    return folder
