"""Draws softfin in one figure, from the benchmark's JSON: the error of each controller against the
time to make it from logs.

    python -m studies.one_figure docs/one-figure.png
"""

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from results.record import load

from softfin.core.window import interval
from softfin.storage.figures import BLUE, GREEN, GREY, ORANGE, new_figure, save_figure, styled

GROUPS = {
    "gaits": (BLUE, "o", {"gaits": "gaits", "gaits-feedback": "gaits with feedback"}),
    "single policy": (
        ORANGE,
        "s",
        {
            "single-30000": "30,000 actions",
            "single-100000": "100,000",
            "single-300000": "300,000",
            "single": "400,000, default",
        },
    ),
    "grid of six policies": (
        GREEN,
        "D",
        {
            "grid-5000": "5,000 each",
            "grid-16700": "16,700",
            "grid-30000": "30,000",
            "grid-50000": "50,000",
            "grid": "66,000, default",
            "grid-100000": "100,000",
        },
    ),
    "formulas and sines": (GREY, "^", {"law": "amplitude law", "sine": "best sines"}),
}
"""Colour, marker and rows of each group, with the labels of the rows."""

PAPER_N = {"single": (0.828, 0.685), "grid": (0.435, 0.537)}
"""Mean errors x, y over the six references that the paper measured on its fin (Table II)."""

ANALYTIC = {"inverse": "rigid-fin inverse model", "still": "still fin"}
"""Rows that need no logs."""


def mean_errors(figures: dict, row: str) -> Float[np.ndarray, "seeds"]:
    """Return the mean error of both axes for each seed [N]."""
    return np.mean(figures[f"{row}.error"]["values"], axis=1)


def draw_group(axes: Axes, figures: dict, title: str) -> None:
    """Draw a point with a 95% interval over the seeds for each row."""
    colour, marker, rows = GROUPS[title]
    for index, (row, label) in enumerate(rows.items()):
        errors = mean_errors(figures, row)
        minutes = np.median(figures[f"{row}.processor"]["values"]) / 60
        mean = errors.mean()
        low, high = interval(errors) or (mean, mean)
        bars = [[mean - max(low, 1e-3)], [high - mean]]
        axes.errorbar(
            minutes,
            mean,
            bars,
            fmt=marker,
            color=colour,
            capsize=2,
            label=None if index else title,
        )
        place = {"s": (6, -9), "^": (-4, 9)}.get(marker, (6, 4))
        axes.annotate(label, (minutes, mean), place, textcoords="offset points", fontsize=7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, help="PNG to write")
    file = parser.parse_args().file
    figures = load("benchmark")["figures"]
    with styled():
        figure = new_figure(6.6, 4.4)
        axes = figure.subplots()
        for title in GROUPS:
            draw_group(axes, figures, title)
        axes.set(yscale="log", ylim=(0.005, 2), xlim=(3.5, 8))
        axes.set(xlabel="processor time from logs to the controller [min]")
        axes.set(ylabel="mean error of the force, x and y [N]")
        right = axes.get_xlim()[1]
        lines = {f"paper, real fin: {name}": np.mean(pair) for name, pair in PAPER_N.items()}
        lines |= {label: mean_errors(figures, row).mean() for row, label in ANALYTIC.items()}
        for label, error in lines.items():
            is_paper = label.startswith("paper")
            axes.axhline(error, linestyle="-" if is_paper else ":", color="black", linewidth=0.8)
            axes.annotate(
                label, (right, error), (-3, 2), ha="right", textcoords="offset points", fontsize=7
            )
        axes.legend(loc="lower right", ncols=2)
    save_figure(figure, file)


if __name__ == "__main__":
    main()
