"""The figure of a force map: reachable mean forces and the Sobolev terms of their gaits."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage.figures import BLACK, GREY, new_figure, styled

MARGIN_N = 0.2
"""Margin around the nodes for the paper's fin [N]."""


HALO = [withStroke(linewidth=3, foreground="white")]

MIN_RANGE_N = 0.01
"""Minimum range of the plotted Sobolev terms for the paper's fin [N]."""


def map_figure(force_map: ForceMap, tolerance_n: float) -> Figure:
    """Plot the Sobolev term (form `mean`, both axes) of the gait at each reachable node.

    Nodes with a force error within the tolerance are marked with dots, all others with crosses.
    """
    gaits, reachable, _ = force_map
    nodes = gaits.table.references()
    cost = gaits.smoothness.sum(axis=-1)
    held = gaits.force_error() <= tolerance_n
    outline = np.concatenate([reachable.corners(), reachable.corners()[:1]])
    # The levels are round numbers; if all values are equal, the range is widened.
    levels = MaxNLocator(12).tick_values(
        float(cost.min()), max(float(cost.max()), float(cost.min()) + MIN_RANGE_N * reachable.size)
    )
    with styled():
        figure = new_figure(6.4, 5.2)
        axes = figure.subplots()
        colours = axes.contourf(nodes[..., 0], nodes[..., 1], cost, levels=levels, cmap="Blues")
        # Nodes outside the region have the gait of the nearest reachable force, so their values
        # must not be shown.
        colours.set_clip_path(Polygon(outline, transform=axes.transData))
        axes.plot(*outline.T, color=BLACK, linewidth=1.6, label="edge of the reachable region")
        axes.plot(
            *nodes[held].T,
            "o",
            color=BLACK,
            markersize=2.5,
            path_effects=HALO,
            label="a gait produces this force",
        )
        if not held.all():
            axes.plot(
                *nodes[~held].T,
                "x",
                color=GREY,
                markersize=4,
                label="no gait found for this force",
            )
        # Fins of different sizes may reach none of the references.
        if reachable.contains(PAPER_REFERENCES).any():
            axes.plot(
                *np.transpose(PAPER_REFERENCES),
                "o",
                fillstyle="none",
                color=BLACK,
                markersize=11,
                markeredgewidth=1.4,
                path_effects=HALO,
                label="the paper's references",
            )
        margin_n = MARGIN_N * reachable.size
        left, bottom = np.minimum(nodes[0, 0], outline.min(axis=0)) - margin_n
        right, top = np.maximum(nodes[-1, -1], outline.max(axis=0)) + margin_n
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.set(xlabel="mean force x [N]", ylabel="mean force y [N]")
        figure.colorbar(
            colours, ax=axes, label="Sobolev term of the gait, sum of x and y [N]", shrink=0.9
        )
        figure.legend(loc="outside lower center", ncols=2)
    return figure
