"""How well a controller holds each force of a plane: a lattice of references over its range, as numbers and a heat map.

Controller and plant go in; all references run side by side in one compiled program.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from softfin.control.controller import Controller
from softfin.control.references import reachable_of
from softfin.core.errors import CoverageError
from softfin.core.quantities import AXES
from softfin.evaluation.coverage import bounds, covers
from softfin.evaluation.experiment import Subject, check_finite, run
from softfin.evaluation.paper import REFERENCES
from softfin.evaluation.scores import score
from softfin.gaits.reachable import Cell
from softfin.storage.figures import BLACK, new_figure, styled

POINTS = 7
"""References along each side of the lattice."""

COLOURS = "Blues"
"""Of the errors: light where they are small; the same to the colour-blind, and in grey."""

WRITTEN = 11
"""Points along a side up to which the numbers are written into the map."""


class ErrorMap(NamedTuple):
    """Errors over the references of a lattice."""

    cell: Cell
    """The range, of which each reference is the middle of an equal part."""
    points: int
    """References along each side."""
    references: Float[np.ndarray, "references 2"]
    """Those that the controller covers and the fin can make [N]; fewer than ``points ** 2`` where some are not."""
    error: Float[np.ndarray, "references 2"]
    """Mean |moving average - reference| [N]."""
    reachable: Float[np.ndarray, "corners 2"] | None = None
    """Outline of the mean forces that the fin can make [N], where it is known."""
    not_reachable: int = 0
    """References of the lattice that the controller covers and the fin cannot make."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        rows = [
            {"reference_n": reference, "error_x_n": x, "error_y_n": y}
            for reference, (x, y) in zip(self.references.tolist(), self.error.tolist(), strict=True)
        ]
        return {
            "points": self.points,
            "low_n": list(self.cell.low),
            "high_n": list(self.cell.high),
            "seeds": 1,
            "not_covered": self.points**2 - len(rows) - self.not_reachable,
            "not_reachable": self.not_reachable,
            "references": rows,
            **{f"mean_{axis}_n": float(self.error[:, i].mean()) for i, axis in enumerate(AXES)},
            **{f"worst_{axis}_n": float(self.error[:, i].max()) for i, axis in enumerate(AXES)},
        }


def error_map(
    controller: Controller,
    plant: Subject,
    references: Float[np.ndarray, "references 2"],
    seconds: int,
    key: PRNGKeyArray,
) -> Float[np.ndarray, "references 2"]:
    """Mean |moving average - reference| of each reference [N], from rest, over whole seconds, on one seed."""
    recording = run(controller, plant, np.asarray(references, np.float32), seconds, jnp.stack([key]))
    check_finite(recording)
    return score(recording).error[:, 0]


def map_range(controller: Controller, plant: Subject, points: int, seconds: int, key: PRNGKeyArray) -> ErrorMap:
    """The errors over a lattice of the controller's range; raises CoverageError where none can be held."""
    cell = bounds(controller)
    if cell.low[0] == cell.high[0] or cell.low[1] == cell.high[1]:
        raise CoverageError(f"an error map over {cell}: the controller's range has no area; train it for a wider cell")
    covered = [reference for reference in cell.lattice(points) if covers(controller, reference)]
    if not covered:
        raise CoverageError(
            f"an error map of {points} x {points} references over {cell}: the controller covers none of them; ask for "
            "more points"
        )
    references, reachable = np.array(covered), reachable_of(controller)
    if reachable is not None:
        references = references[reachable.contains(references)]
    if not len(references):
        raise CoverageError(
            f"an error map of {points} x {points} references over {cell}: this fin can make none of them; ask for more "
            "points, or train the controller within the fin's reach (softfin map shows it)"
        )
    error = error_map(controller, plant, references, seconds, key)
    outline = None if reachable is None else reachable.corners()
    return ErrorMap(cell, points, references, error, outline, len(covered) - len(references))


def error_map_figure(errors: ErrorMap) -> Figure:
    """Heat maps of the error in x and y, with the paper's references and the forces that the fin can make."""
    lattice = _on_lattice(errors)
    greatest = float(errors.error.max())
    with styled():
        figure = new_figure(9.6, 4.6)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for index, (axes, axis) in enumerate(zip(panels, AXES, strict=True)):
            drawn = _draw_errors(axes, errors, lattice[..., index], greatest)
            if errors.points <= WRITTEN:
                _write(axes, errors.references, errors.error[:, index], greatest)
            _draw_marks(axes, errors.reachable)
            mean, worst = errors.error[:, index].mean(), errors.error[:, index].max()
            axes.set_title(f"error {axis}: mean {mean:.2f} N, worst {worst:.2f} N", weight="bold")
            axes.set(xlabel="reference force x [N]", aspect="equal")
        panels[0].set_ylabel("reference force y [N]")
        figure.colorbar(drawn, ax=panels, label="mean |moving average \N{MINUS SIGN} reference| [N]", shrink=0.9)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def _on_lattice(errors: ErrorMap) -> Float[np.ndarray, "points points 2"]:
    """By row of y and column of x; NaN where no reference is held."""
    lattice = np.full((errors.points, errors.points, 2), np.nan)
    low, high = np.array(errors.cell.low), np.array(errors.cell.high)
    column, row = np.floor((errors.references - low) / (high - low) * errors.points).astype(int).T
    lattice[row, column] = errors.error
    return lattice


def _draw_errors(axes: Axes, errors: ErrorMap, values: Float[np.ndarray, "points points"], greatest: float) -> Any:
    (left, bottom), (right, top) = errors.cell.low, errors.cell.high
    axes.grid(visible=False)
    # What the controller does not cover or the fin cannot make: no colour of the map.
    axes.patch.set(facecolor="white", hatch="////", edgecolor="#CCCCCC")
    drawn = axes.imshow(
        values, origin="lower", extent=(left, right, bottom, top), vmin=0, vmax=greatest, cmap=COLOURS,
        interpolation="nearest",
    )  # fmt: skip
    return drawn


def _write(
    axes: Axes, references: Float[np.ndarray, "references 2"], values: Float[np.ndarray, "references"], greatest: float
) -> None:
    for (x, y), value in zip(references, values, strict=True):
        colour = "white" if value > 0.6 * greatest else BLACK
        # Over a mark, on a patch of the map's own colour.
        patch = {"facecolor": colormaps[COLOURS](value / greatest), "edgecolor": "none", "pad": 0.8}
        axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour, bbox=patch)


def _draw_marks(axes: Axes, reachable: Float[np.ndarray, "corners 2"] | None) -> None:
    x, y = np.array(REFERENCES, float).T
    axes.plot(
        x, y, "o", fillstyle="none", color=BLACK, markersize=16, markeredgewidth=1.4, label="the paper's references",
    )  # fmt: skip
    if reachable is not None:
        closed = np.concatenate([reachable, reachable[:1]])
        axes.plot(*closed.T, color=BLACK, linestyle="--", linewidth=1.4, label="forces that the fin can make",
                  path_effects=[withStroke(linewidth=3, foreground="white")])  # fmt: skip
