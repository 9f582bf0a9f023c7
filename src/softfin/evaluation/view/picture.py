"""Frames of footage, drawn by Matplotlib: static parts are drawn once, and moving parts over a copy
of them.

Footage goes in, images of ``(height, width, 3)`` bytes come out; `files` writes them. An
EpisodeFilm draws an episode of the Gymnasium environment while it runs.
"""

import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from scipy.interpolate import CubicHermiteSpline

from softfin.core.action_clock import MAX_ACTION_TICKS, WINDOW
from softfin.core.plant import Plant, State, rest_command
from softfin.core.quantities import AXES, TICK_S, Command, Limits
from softfin.evaluation.view.footage import (
    AxisRange,
    Footage,
    Scale,
    choose_scale,
    develop,
    max_sizes,
    shoot,
)
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled
from softfin.tank import Tank

Image = UInt8[np.ndarray, "height width 3"]
OutlinePoints = Float[np.ndarray, "points 2"]

FIN = "#3E4C59"
WATER = "#F1F6FA"

TRAIL_TICKS = (5, 10, 15, 20, 25)
"""Ages of the faint shapes behind the fin [10 ms]."""

PANEL = 0.92
"""Ratio of width to height of the visible part of the tank, about that of its panel in the
figure."""

ARROW = 0.035
"""Width of the force arrow relative to the length of the fin."""

PIECES = 6
"""Number of straight pieces drawn between two points of the fin."""


class Picture:
    """A figure whose moving parts are set to one tick after another.

    For footage that is still `growing`, its scale and the seconds of the time axis are given, and
    nothing is drawn in advance.
    """

    def __init__(
        self,
        footage: Footage,
        title: str,
        dots_per_inch: int = 100,
        growing: tuple[Scale, float] | None = None,
    ) -> None:
        # Typed as Any, because optional parts of the footage are drawn only if they exist.
        self.footage: Any = footage
        self._growing = growing is not None
        self.scale, self._seconds = growing or (choose_scale(footage), len(footage.shape) * TICK_S)
        # Moving artists, each with the function that sets it to a tick.
        self._moving: list[tuple[Any, Callable[[int], Any]]] = []
        with styled():
            self.figure = new_figure(9.6, 5.2)
            self.figure.set_dpi(dots_per_inch)
            # Typed as Any, because Matplotlib's canvas has no types.
            self._canvas = cast(Any, FigureCanvasAgg(self.figure))
            grid = self.figure.add_gridspec(3, 2, width_ratios=(1.05, 1))
            self._draw_tank(self.figure.add_subplot(grid[:, 0]), title)
            self._draw_traces([self.figure.add_subplot(grid[row, 1]) for row in range(3)])
            for artist, _ in self._moving:
                artist.set_animated(True)
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self.figure.bbox)

    def frame(self, tick: int) -> Image:
        """Return the picture at a tick, counted from 0; -1 is the last one."""
        self._canvas.restore_region(self._still)
        for artist, update in self._moving:
            update(tick % len(self.footage.shape))
            artist.axes.draw_artist(artist)
        return np.array(self._canvas.buffer_rgba())[..., :3]

    def _add_polygon(
        self, axes: Axes, colour: str, outline: Callable[[int], OutlinePoints], alpha: float = 1.0
    ) -> Polygon:
        polygon = Polygon(
            np.zeros((3, 2)), closed=True, facecolor=colour, edgecolor="none", alpha=alpha
        )
        self._moving.append((axes.add_patch(polygon), lambda tick: polygon.set_xy(outline(tick))))
        return polygon

    def _draw_tank(self, axes: Axes, title: str) -> None:
        footage = self.footage
        scale = self.scale
        length = self.scale.length_m
        # A band at the top for clock and keys, and one at the bottom if there is a note.
        above = 0.16 * length if footage.reference is None else 0.27 * length
        below = 0.0 if footage.shape_known else 0.16 * length
        xlim, ylim = _filling(scale.x, (scale.y[0] - below, scale.y[1] + above))
        axes.set(xlim=xlim, ylim=ylim, aspect="equal", xlabel="x [m], thrust is +x", ylabel="y [m]")
        axes.set_facecolor(WATER)
        axes.grid(color="white", linewidth=1.0)
        axes.set_title(title, weight="bold")

        def fin(ago: int, tick: int) -> OutlinePoints:
            return fin_outline(self.footage.shape[max(tick - ago, 0)], self.footage.thickness)

        def mean(tick: int) -> Any:
            return self.footage.average[tick + 1 - WINDOW] if tick + 1 >= WINDOW else np.zeros(2)

        def add_arrow(
            colour: str,
            vector: Callable[[int], Any],
            metres: float,
            width: float = 1.0,
            alpha: float = 1.0,
        ) -> Polygon:
            def outline(tick: int) -> OutlinePoints:
                arrow = np.asarray(vector(tick) * metres, float)
                return arrow_outline(arrow, width * ARROW * length)

            return self._add_polygon(axes, colour, outline, alpha)

        # The longer ago, the fainter; the fin itself last, over them.
        for ago, alpha in zip(TRAIL_TICKS, np.linspace(0.16, 0.04, len(TRAIL_TICKS)), strict=True):
            self._add_polygon(axes, FIN, partial(fin, ago), float(alpha))
        self._add_polygon(axes, FIN, partial(fin, 0))
        per_mean = scale.metres_per_mean_newton
        self.arrows = {}
        if footage.reference is not None:
            self.arrows["asked"] = add_arrow(
                ORANGE, lambda tick: self.footage.reference[tick], per_mean
            )
        self.arrows["force"] = add_arrow(
            BLUE, lambda tick: self.footage.force[tick], scale.metres_per_newton, alpha=0.9
        )
        self.arrows["mean"] = add_arrow(BLACK, mean, per_mean, width=0.5)
        shaft = Circle((0, 0), 0.025 * length, facecolor="white", edgecolor=BLACK, linewidth=1.4)
        self._moving.append((axes.add_patch(shaft), lambda tick: None))
        corner: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 10}
        clock = axes.text(0.03, 0.96, "", va="top", weight="bold", color=BLACK, **corner)
        self._moving.append((clock, lambda tick: clock.set_text(f"{(tick + 1) * TICK_S:.2f} s")))
        self._draw_key(axes, xlim[1] - 0.06 * length, ylim[1])
        if not footage.shape_known:
            axes.text(0.03, 0.03, "shape not known: drawn straight", color=GREY, **corner)

    def _draw_key(self, axes: Axes, right: float, top: float) -> None:
        """Draw arrows of round forces as a key."""
        scale = self.scale
        name = "force" if self.footage.true_force is None else "true force"
        keys = [(f"{name} {scale.key_n:g} N", scale.key_n * scale.metres_per_newton, BLUE)]
        if self.footage.reference is not None:
            text = f"target, mean {scale.mean_key_n:g} N"
            keys.append((text, scale.mean_key_n * scale.metres_per_mean_newton, BLACK))
        for row, (text, length, colour) in enumerate(keys):
            middle = top - (0.1 + 0.11 * row) * scale.length_m
            axes.plot(
                [right - length, right],
                [middle, middle],
                color=colour,
                linewidth=2.5,
                solid_capstyle="butt",
            )
            axes.text(
                right - length - 0.03 * scale.length_m,
                middle,
                text,
                ha="right",
                va="center",
                color=colour,
            )

    def _draw_traces(self, panels: Sequence[Axes]) -> None:
        for axes in panels:
            cursor = axes.axvline(0, color=BLACK, linewidth=0.9)
            self._moving.append((cursor, partial(_move_cursor, cursor)))
        angle, *forces = panels
        self._trace(angle, ORANGE, 1.3, "command.angle", style="steps-pre")
        self._trace(angle, BLUE, 1.3, "reading.angle")
        angle.set(ylabel="angle [rad]", ylim=self.scale.angle)
        # A true force is not a measurement.
        is_read = self.footage.true_force is None
        force, blue = ("force", "measured") if is_read else ("true force", "angle, true force")
        for i, axes in enumerate(forces):
            if self.footage.reference is not None:
                self._trace(axes, ORANGE, 1.6, "reference", i, style="steps-pre")
            self._trace(axes, BLUE, 0.9, "force", i)
            self._trace(axes, BLACK, 1.8, "average", i, start=WINDOW - 1)
            axes.set(ylabel=f"{force} {AXES[i]} [N]", ylim=self.scale.force)
        for axes in panels:
            axes.set_xlim(0, self._seconds)
            axes.tick_params(labelbottom=axes is panels[-1])
        keys = {"target": ORANGE, blue: BLUE, "mean over 2 s": BLACK}
        lines = [
            Line2D([], [], color=colour, linewidth=2, label=label) for label, colour in keys.items()
        ]
        angle.legend(
            handles=lines,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=3,
            borderaxespad=0.1,
            handlelength=1.4,
            columnspacing=1.2,
        )
        panels[-1].set_xlabel("time [s]")
        self.figure.align_ylabels(list(panels))

    def _trace(
        self,
        axes: Axes,
        colour: str,
        width: float,
        series: str,
        column: int | None = None,
        start: int = 0,
        style: str = "default",
    ) -> None:
        """Draw a series of the footage, or a column of one: what has passed in full, and the whole
        of it faint, where that is known; `start` is its first tick."""

        def values() -> Any:
            chosen = operator.attrgetter(series)(self.footage)
            return chosen if column is None else chosen[:, column]

        def times(series: Any) -> Any:
            return (np.arange(len(series)) + start + 1) * TICK_S

        def update(tick: int) -> None:
            passed = values()[: max(tick + 1 - start, 0)]
            line.set_data(times(passed), passed)

        if not self._growing:
            whole = values()
            axes.plot(
                times(whole), whole, color=colour, linewidth=width, alpha=0.25, drawstyle=style
            )
        (line,) = axes.plot([], [], color=colour, linewidth=width, drawstyle=style)
        self._moving.append((line, update))


class EpisodeFilm:
    """Draws a plant that is recorded action by action.

    The plant is simulated a second time, tick by tick: it is pure, so it moves as it did for the
    task.
    """

    def __init__(self, plant: Plant, seconds: float, greatest_reference_n: float) -> None:
        self._plant = plant
        self._limits = Limits(*plant.limits)
        self._seconds = seconds
        self._shoot = jax.jit(partial(shoot, plant))
        self._greatest = np.full(2, greatest_reference_n)
        self._rest: Any = None
        self._actions: list[Any] = []
        self._picture: Picture | None = None

    def reset(self, state: State, reference: Float[np.ndarray, "2"]) -> None:
        """Begin with a fin at rest, one tick later; the first action replaces that tick."""
        self._rest = self._roll(state, rest_command(self._limits), 1, reference)
        self._actions = []

    def add(
        self, state: State, command: Command, ticks: int, reference: Float[np.ndarray, "2"]
    ) -> None:
        """Add an action: the plant before it, its command, its duration, and the reference [N]."""
        self._actions.append(self._roll(state, command, ticks, reference))

    def _roll(
        self, state: State, command: Command, ticks: int, reference: Float[np.ndarray, "2"]
    ) -> Any:
        # One compiled program, for the longest action: a tick does not depend on those that follow.
        commands = Command(*(jnp.full(MAX_ACTION_TICKS, field, jnp.float32) for field in command))
        rolled = jax.tree.map(
            lambda x: np.asarray(x)[:ticks], (commands, self._shoot(state, commands))
        )
        return *rolled, np.tile(np.asarray(reference, np.float32), (ticks, 1))

    def frame(self) -> Image:
        """Return the picture of this moment."""
        parts = self._actions or [self._rest]
        command, shots, reference = jax.tree.map(lambda *parts: np.concatenate(parts), *parts)
        footage = develop(self._plant, command, shots, reference)
        greatest = max_sizes(footage)
        outgrown = greatest > self._greatest
        if self._picture is None or outgrown.any():
            # Twice the required range, so that the scale rarely changes.
            self._greatest = np.where(outgrown, 2 * greatest, self._greatest)
            scale = choose_scale(
                footage, self._greatest, (self._limits.angle_min, self._limits.angle_max)
            )
            where = (
                "the virtual tank" if isinstance(self._plant, Tank) else type(self._plant).__name__
            )
            self._picture = Picture(
                footage, f"A soft fin in {where}", growing=(scale, self._seconds)
            )
        self._picture.footage = footage
        return self._picture.frame(-1)


def _move_cursor(cursor: Line2D, tick: int) -> None:
    cursor.set_xdata([(tick + 1) * TICK_S])


def _filling(x: AxisRange, y: AxisRange) -> tuple[AxisRange, AxisRange]:
    """Return both ranges; the one that is too short for the shape of the panel is extended at both
    ends."""
    width = x[1] - x[0]
    height = y[1] - y[0]
    more_x = max(PANEL * height - width, 0) / 2
    more_y = max(width / PANEL - height, 0) / 2
    return (x[0] - more_x, x[1] + more_x), (y[0] - more_y, y[1] + more_y)


def smooth(points: OutlinePoints) -> Float[np.ndarray, "pieces 2"]:
    """Return a curve through the points (Catmull and Rom 1974)."""
    # A cubic through each point whose slope there is that between its neighbours.
    places = np.arange(len(points))
    curve = CubicHermiteSpline(places, points, np.gradient(points, axis=0))
    return np.asarray(curve(np.linspace(0, places[-1], places[-1] * PIECES + 1)))


def fin_outline(
    middle: OutlinePoints, thickness: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "corners 2"]:
    """Return the outline of a fin with `thickness` at the points of its centre line, smoothed, with
    a rounded tip."""
    line = smooth(middle)
    half = np.interp(np.linspace(0, 1, len(line)), np.linspace(0, 1, len(thickness)), thickness) / 2
    # Unit tangents, and normals a quarter turn to the left of them.
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    offset = half[:, None] * normal
    # Half a circle from the left edge round the tip to the right one, without its two ends, which
    # the edges have.
    turn = np.linspace(np.pi / 2, -np.pi / 2, 9)[1:-1, None]
    tip = line[-1] + half[-1] * (np.sin(turn) * normal[-1] + np.cos(turn) * along[-1])
    return np.concatenate([line + offset, tip, (line - offset)[::-1]])


def arrow_outline(vector: Float[np.ndarray, "2"], width_m: float) -> Float[np.ndarray, "7 2"]:
    """Return the outline of an arrow from the shaft; a short one is narrower, so that it keeps its
    shape and vanishes at zero."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0 else np.zeros(2)
    head = min(3.2 * width_m, 0.6 * length)
    # One side from the shaft to the tip, along and across; the other side is its mirror image.
    far, wide = np.array([(0, 0.5), (length - head, 0.5), (length - head, 1.5), (length, 0)]).T[
        :, :, None
    ]
    across = head / 3.2 * wide * np.array([-along[1], along[0]])
    return np.concatenate([along * far + across, (along * far - across)[2::-1]])
