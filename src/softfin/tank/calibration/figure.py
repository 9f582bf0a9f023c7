"""Measured and modelled over the same unseen commands: traces of a segment, and mean forces."""

from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from softfin.core.quantities import RATE_HZ
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled
from softfin.tank.calibration.segments import CHANNELS, Segments

Scores: TypeAlias = dict[str, dict[str, float]]
"""For each channel ``r2``, ``rmse``, means and standard deviations."""

TRACE_S = 10
"""Duration of a test segment that the figure shows [s]."""

WINDOW = 2 * RATE_HZ
"""Ticks over which means are taken: those of the paper's moving average."""


def calibration_figure(
    test: Segments, modelled: Float[np.ndarray, "segments ticks channels"], scores: Scores
) -> Figure:
    """Draw the test segment of median error, and the mean forces over 2 s of all."""
    measured, ticks = np.asarray(test.measured), slice(test.warm_up, test.warm_up + TRACE_S * RATE_HZ)
    error = (modelled - measured)[:, test.warm_up :] / np.asarray(test.deviation)
    shown = int(np.argsort(np.mean(error**2, axis=(1, 2)))[len(error) // 2])
    command = np.asarray(test.command.angle)[shown, ticks]
    time = np.arange(len(command)) / RATE_HZ
    with styled():
        figure = new_figure(11, 9.5)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.75, 1))
        panels = parts[0].subplots(3, 1, sharex=True)
        panels[0].step(time, command, where="post", color=GREY, linewidth=0.8, linestyle=":", label="commanded")
        titles = ("angle [rad]", "force x [N]", "force y [N]")
        for index, (axes, title, channel) in enumerate(zip(panels, titles, CHANNELS, strict=True)):
            axes.plot(time, measured[shown, ticks, index], color=BLACK, linewidth=1.6, label="measured")
            axes.plot(time, modelled[shown, ticks, index], color=ORANGE, linewidth=1.3, linestyle="--", label="tank")
            axes.set(ylabel=title, xlim=(0, len(command) / RATE_HZ))
            axes.set_title(f"R² {scores[channel]['r2']:.3f} over all unseen segments", loc="right")
        panels[0].set_title("The unseen segment of median error", weight="bold")
        panels[0].legend(ncols=3, loc="lower left", bbox_to_anchor=(0.25, 0.98), borderaxespad=0)
        panels[-1].set_xlabel("time [s]")
        axes = parts[1].subplots()
        for readings, filled, source in ((measured, True, "measured"), (modelled, False, "tank")):
            compared = readings[:, test.warm_up :]
            whole = compared[:, : compared.shape[1] // WINDOW * WINDOW]
            angle, *forces = whole.reshape(-1, WINDOW, len(CHANNELS)).mean(axis=1).T
            for force, colour, marker, name in zip(forces, (BLUE, ORANGE), "os", "xy", strict=True):
                face = colour if filled else "white"
                axes.plot(angle, force, marker, markersize=3, color=colour, markerfacecolor=face,
                          label=f"force {name}, {source}")  # fmt: skip
        axes.axhline(0, color=GREY, linewidth=0.8)
        axes.set(xlabel="mean angle [rad]", ylabel="mean force [N]")
        axes.set_title("Means over 2 s of random commands", fontsize=8)
        axes.legend(fontsize=7, loc="best")
    return figure
