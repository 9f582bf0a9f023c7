"""The figure of a force map: reachable mean forces, the Sobolev terms of their gaits and, if it is
known, their power."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from softfin.gaits.gait import ForceMap, GaitSearchResult
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.storage.figures import BLACK, GREY, new_figure, styled

MARGIN_N = 0.2
"""Margin around the nodes for the paper's fin [N]."""


HALO = [withStroke(linewidth=3, foreground="white")]

MIN_RANGE = 0.01
"""Minimum range of the plotted values for the paper's fin [N, W or N/W]."""

MIN_POWER_W = 0.05
"""Power below which N/W is not plotted for the paper's fin, because both are almost 0 [W]."""

Values = Float[np.ndarray, "x y"]


def map_figure(force_map: ForceMap, tolerance_n: float) -> Figure:
    """Plot the Sobolev term (form `mean`, both axes) of the gait at each reachable node; next to
    it, the power and the force per watt if they are known.

    Nodes with a force error within the tolerance are marked with dots, all others with crosses.
    """
    costs = _costs(force_map.gaits, force_map.reachable.size)
    with styled():
        figure = new_figure(6.4 if len(costs) == 1 else 4.6 * len(costs), 5.2)
        panels = figure.subplots(1, len(costs), squeeze=False)[0]
        for axes, (label, values) in zip(panels, costs.items(), strict=True):
            colours = _plot_map(axes, force_map, values, tolerance_n)
            figure.colorbar(colours, ax=axes, label=label, shrink=0.9 if len(costs) == 1 else 0.7)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _costs(gaits: GaitSearchResult, size: float) -> dict[str, Values]:
    """Return the values of each panel by label."""
    costs = {"Sobolev term of the gait, sum of x and y [N]": gaits.smoothness.sum(axis=-1)}
    if gaits.power is None:
        return costs
    force = np.linalg.norm(gaits.force, axis=-1)
    return costs | {
        "mechanical power of the gait [W]": gaits.power,
        "force per power [N/W]": force / np.maximum(gaits.power, MIN_POWER_W * size),
    }


def _plot_map(
    axes: Axes, force_map: ForceMap, values: Values, tolerance_n: float
) -> QuadContourSet:
    gaits, reachable, _ = force_map
    nodes = gaits.table.references()
    held = gaits.force_error() <= tolerance_n
    outline = np.concatenate([reachable.corners(), reachable.corners()[:1]])
    # The levels are round numbers; if all values are equal, the range is widened.
    low = float(values.min())
    high = max(float(values.max()), low + MIN_RANGE * reachable.size)
    levels = MaxNLocator(12).tick_values(low, high)
    colours = axes.contourf(nodes[..., 0], nodes[..., 1], values, levels=levels, cmap="Blues")
    # Nodes outside the region have the gait of the nearest reachable force, so their values must
    # not be shown.
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
    return colours
