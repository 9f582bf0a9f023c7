"""Draws a fin from above with forces on its mount, for the Gymnasium environment and the
documentation."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from softfin.storage.figures import BLACK, BLUE, ORANGE

ARROWS = {"force": BLUE, "mean force": BLACK, "target force": ORANGE}
"""Colour of each arrow by name, in the order of the forces."""

CentreLine = Float[np.ndarray, "points 2"]
Forces = Float[np.ndarray, "forces 2"]


def draw_fin(axes: Axes, shape: CentreLine, forces: Forces, scale_n: float) -> None:
    """Draw the centre line of a fin [m], and up to three forces (x, y) on its mount [N] as arrows,
    in the order of `ARROWS`. The arrow of a force of `scale_n` is as long as the fin."""
    length = np.linalg.norm(np.diff(shape, axis=0), axis=1).sum()
    axes.plot(*shape.T, color="#3E4C59", linewidth=9, solid_capstyle="round")
    for (x, y), (name, colour) in zip(forces * length / scale_n, ARROWS.items(), strict=False):
        axes.quiver(x, y, color=colour, label=name, angles="xy", scale_units="xy", scale=1)
    axes.plot(0, 0, "o", color="white", markersize=9, markeredgecolor=BLACK)
    axes.set(aspect="equal", xlabel="x [m], thrust is +x", ylabel="y [m]")
    axes.axis(1.2 * length * np.array([-1, 1, -1, 1]))
