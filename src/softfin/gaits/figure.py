"""The figure of a force map: the mean forces that a fin can make, and the Sobolev terms of their gaits."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from softfin.core.quantities import Limits
from softfin.gaits.force_map import MapConfig
from softfin.gaits.gait import ForceMap
from softfin.gaits.map_store import save_map
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage.figures import BLACK, GREY, new_figure, save_figure, styled

COLOURS = "Blues"


def map_figure(force_map: ForceMap, tolerance_n: float) -> Figure:
    """Draw one panel: colour is the Sobolev term (form `mean`, both axes) of the gait at each reachable node.

    A node counts as held where its gait's force error is within the tolerance.
    """
    gaits, reachable = force_map
    nodes = gaits.table.references()
    cost, held = gaits.smoothness.sum(axis=-1), gaits.force_error() <= tolerance_n
    outline = np.concatenate([reachable.corners(), reachable.corners()[:1]])
    with styled():
        figure = new_figure(6.4, 5.2)
        axes = figure.subplots()
        colours = axes.contourf(nodes[..., 0], nodes[..., 1], cost, levels=_levels(cost), cmap=COLOURS)
        # Nodes beyond reach hold the gait of the nearest force: what lies outside the outline is no result.
        low, high = nodes[0, 0] - 1, nodes[-1, -1] + 1
        frame = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
        axes.fill(*_ring(frame, outline).T, facecolor="white", edgecolor="none")
        axes.plot(*outline.T, color=BLACK, linewidth=1.6, label="edge of what the fin can make")
        halo = [withStroke(linewidth=3, foreground="white")]
        axes.plot(*nodes[held].T, "o", color=BLACK, markersize=2.5, path_effects=halo, label="a gait makes this force")
        if not held.all():
            axes.plot(*nodes[~held].T, "x", color=GREY, markersize=4, label="no gait found makes this force")
        x, y = np.array(PAPER_REFERENCES, float).T
        axes.plot(x, y, "o", fillstyle="none", color=BLACK, markersize=11, markeredgewidth=1.4, path_effects=halo,
                  label="the paper's references")  # fmt: skip
        left, bottom = np.minimum(nodes[0, 0], outline.min(axis=0)) - 0.2
        right, top = np.maximum(nodes[-1, -1], outline.max(axis=0)) + 0.2
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.set(xlabel="mean force x [N]", ylabel="mean force y [N]")
        figure.colorbar(colours, ax=axes, label="Sobolev term of the gait, x and y together [N]", shrink=0.9)
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def write_map(
    out: Path,
    force_map: ForceMap,
    config: MapConfig,
    limits: Limits,
    provenance: dict[str, Any],
    overwrite: bool = False,
) -> None:
    """Write the map's folder with its figure, ``map.svg`` and ``map.png``."""

    def draw(folder: Path) -> None:
        figure = map_figure(force_map, config.tolerance_n)
        save_figure(figure, folder, "map")

    save_map(out, force_map, config, limits, provenance, draw, overwrite)


def _levels(cost: Float[np.ndarray, "x y"]) -> Float[np.ndarray, "levels"]:
    """Choose round levels over all values, with some breadth where all are the same."""
    low, high = float(cost.min()), float(cost.max())
    return np.asarray(MaxNLocator(12).tick_values(low, max(high, low + 0.01)), np.float64)


def _ring(frame: Float[np.ndarray, "corners 2"], hole: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "n 2"]:
    """Join a frame and a hole into one outline; the hole runs the other way round."""
    return np.concatenate([frame, hole[::-1], frame[:1]])
