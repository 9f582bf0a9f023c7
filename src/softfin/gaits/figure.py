"""What a fin can do, drawn: the mean forces that it can make, and the Sobolev cost of making them."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from softfin.core.quantities import Limits
from softfin.gaits.force_map import ForceMap, MapConfig
from softfin.gaits.map_store import save_map
from softfin.storage.figures import BLACK, GREY, new_figure, save_figure, styled
from softfin.task.references import PAPER_REFERENCES

COLOURS = "Blues"


def map_figure(known: ForceMap, tolerance_n: float) -> Figure:
    """One panel: colour is the Sobolev term (form `mean`, both axes) of the gait at each node within reach.

    A node counts as held where its gait comes as near as the tolerance.
    """
    found, reachable = known.found, known.reachable
    nodes = found.table.references()
    cost, held = found.smoothness.sum(axis=-1), found.missed() <= tolerance_n
    outline = np.concatenate([reachable.corners(), reachable.corners()[:1]])
    with styled():
        figure = new_figure(6.4, 5.2)
        axes = figure.subplots()
        drawn = axes.contourf(nodes[..., 0], nodes[..., 1], cost, levels=_levels(cost), cmap=COLOURS)
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
        figure.colorbar(drawn, ax=axes, label="Sobolev term of the gait, x and y together [N]", shrink=0.9)
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def write_map(
    out: Path, known: ForceMap, config: MapConfig, limits: Limits, provenance: dict[str, Any], overwrite: bool = False
) -> None:
    """The map's folder with its figure, ``map.svg`` and ``map.png``."""

    def draw(folder: Path) -> None:
        figure = map_figure(known, config.tolerance_n)
        save_figure(figure, folder, "map")

    save_map(out, known, config, limits, provenance, draw, overwrite)


def _levels(cost: Float[np.ndarray, "x y"]) -> Float[np.ndarray, "levels"]:
    """Round ones over all that there is, and some breadth where all gaits cost the same."""
    low, high = float(cost.min()), float(cost.max())
    return np.asarray(MaxNLocator(12).tick_values(low, max(high, low + 0.01)), np.float64)


def _ring(frame: Float[np.ndarray, "corners 2"], hole: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "n 2"]:
    """A frame with a hole as one outline; the hole runs the other way round."""
    return np.concatenate([frame, hole[::-1], frame[:1]])
