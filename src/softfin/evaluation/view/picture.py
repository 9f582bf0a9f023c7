"""Draw footage with Matplotlib as images of ``(height, width, 3)`` bytes, which `files` writes.

Static parts are drawn once; each frame draws the moving parts over a copy of them. `EpisodeFilm`
draws an episode of the Gymnasium environment while it runs.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from scipy.interpolate import CubicHermiteSpline

from softfin.core.action_clock import ActionClock
from softfin.core.plant import Plant, State, rest_command
from softfin.core.quantities import AXES, TICK_S, AnyArray, Command, Limits
from softfin.evaluation.view.footage import (
    AxisRange,
    Footage,
    FootageSeries,
    Scale,
    Shots,
    choose_scale,
    develop,
    max_sizes,
    shoot,
)
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled
from softfin.tank import Tank

Image = UInt8[np.ndarray, "height width 3"]
OutlinePoints = Float[np.ndarray, "points 2"]
ForceArrow = Float[np.ndarray, "2"]

EpisodePart: TypeAlias = tuple[Command, Shots, FootageSeries]
"""Commands, recorded motion and references of one action."""

FIN = "#3E4C59"
WATER = "#F1F6FA"

TRAIL_TICKS = (5, 10, 15, 20, 25)
"""Ages of the faint shapes that trail the fin [10 ms]."""

PANEL = 0.92
"""Width-to-height ratio of the visible part of the tank, close to that of its panel in the
figure."""

ARROW = 0.035
"""Width of the force arrow, relative to the length of the fin."""

PIECES = 6
"""Number of straight segments drawn between two points of the fin."""


class Picture:
    """A figure whose moving parts can be set to any tick.

    For footage that is still growing, `growing` sets the scale and the length of the time axis [s],
    and no future values are drawn.
    """

    def __init__(
        self,
        footage: Footage,
        title: str,
        dots_per_inch: int = 100,
        growing: tuple[Scale, float] | None = None,
    ) -> None:
        self.footage = footage
        self._growing = growing is not None
        self.scale, self._seconds = growing or (choose_scale(footage), len(footage.shape) * TICK_S)
        # Moving artists, each with the function that updates it to a tick.
        self._moving: list[tuple[Artist, Callable[[int], object]]] = []
        with styled():
            self.figure = new_figure(9.6, 5.2)
            self.figure.set_dpi(dots_per_inch)
            # Matplotlib's canvas has no type annotations.
            self._canvas = cast(Any, FigureCanvasAgg(self.figure))
            grid = self.figure.add_gridspec(3, 2, width_ratios=(1.05, 1))
            self._draw_tank(self.figure.add_subplot(grid[:, 0]), title)
            self._draw_traces([self.figure.add_subplot(grid[row, 1]) for row in range(3)])
            # Animated artists are not part of the static background.
            for artist, _ in self._moving:
                artist.set_animated(True)
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self.figure.bbox)

    def frame(self, tick: int) -> Image:
        """Return the image at a tick, counted from 0; -1 is the last tick."""
        self._canvas.restore_region(self._still)
        for artist, update in self._moving:
            update(tick % len(self.footage.shape))
            self.figure.draw_artist(artist)
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
        # Leave space for the clock and the keys at the top, and for the note at the bottom.
        above = 0.16 * length if footage.reference is None else 0.27 * length
        below = 0.0 if footage.shape_known else 0.16 * length
        xlim, ylim = _filling(scale.x, (scale.y[0] - below, scale.y[1] + above))
        axes.set(xlim=xlim, ylim=ylim, aspect="equal", xlabel="x [m], thrust is +x", ylabel="y [m]")
        axes.set_facecolor(WATER)
        axes.grid(color="white", linewidth=1.0)
        axes.set_title(title, weight="bold")

        def fin(ago: int, tick: int) -> OutlinePoints:
            return fin_outline(self.footage.shape[max(tick - ago, 0)], self.footage.thickness)

        def mean(tick: int) -> ForceArrow:
            # The first window ends at tick `window` - 1.
            window = self.footage.clock.window_ticks
            return self.footage.average[tick + 1 - window] if tick + 1 >= window else np.zeros(2)

        def add_arrow(
            colour: str,
            vector: Callable[[int], ForceArrow],
            metres: float,
            width: float = 1.0,
            alpha: float = 1.0,
        ) -> Polygon:
            def outline(tick: int) -> OutlinePoints:
                arrow = np.asarray(vector(tick) * metres, float)
                return arrow_outline(arrow, width * ARROW * length)

            return self._add_polygon(axes, colour, outline, alpha)

        # Older shapes are fainter; the fin itself is drawn over them.
        for ago, alpha in zip(TRAIL_TICKS, np.linspace(0.16, 0.04, len(TRAIL_TICKS)), strict=True):
            self._add_polygon(axes, FIN, partial(fin, ago), float(alpha))
        self._add_polygon(axes, FIN, partial(fin, 0))
        per_mean = scale.metres_per_mean_newton
        self.arrows = {}
        if footage.reference is not None:
            self.arrows["asked"] = add_arrow(
                ORANGE, lambda tick: _reference(self.footage)[tick], per_mean
            )
        self.arrows["force"] = add_arrow(
            BLUE, lambda tick: self.footage.force[tick], scale.metres_per_newton, alpha=0.9
        )
        self.arrows["mean"] = add_arrow(BLACK, mean, per_mean, width=0.5)
        shaft = Circle((0, 0), 0.025 * length, facecolor="white", edgecolor=BLACK, linewidth=1.4)
        self._moving.append((axes.add_patch(shaft), lambda tick: None))
        clock = axes.text(
            0.03,
            0.96,
            "",
            va="top",
            weight="bold",
            color=BLACK,
            transform=axes.transAxes,
            fontsize=10,
        )
        self._moving.append((clock, lambda tick: clock.set_text(f"{(tick + 1) * TICK_S:.2f} s")))
        self._draw_key(axes, xlim[1] - 0.06 * length, ylim[1])
        if not footage.shape_known:
            axes.text(
                0.03,
                0.03,
                "shape unknown: drawn straight",
                color=GREY,
                transform=axes.transAxes,
                fontsize=10,
            )

    def _draw_key(self, axes: Axes, right: float, top: float) -> None:
        """Draw arrows for round force values as a key."""
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
        # A command is active from the previous tick to its own, hence the steps.
        self._trace(angle, ORANGE, 1.3, _commanded_angle, style="steps-pre")
        self._trace(angle, BLUE, 1.3, _measured_angle)
        angle.set(ylabel="angle [rad]", ylim=self.scale.angle)
        # The true force is not a measurement, so label it differently.
        is_read = self.footage.true_force is None
        window = self.footage.clock.window_ticks
        force, blue = ("force", "measured") if is_read else ("true force", "angle, true force")
        for i, axes in enumerate(forces):
            if self.footage.reference is not None:
                self._trace(axes, ORANGE, 1.6, partial(_reference, axis=i), style="steps-pre")
            self._trace(axes, BLUE, 0.9, partial(_force, axis=i))
            self._trace(axes, BLACK, 1.8, partial(_average, axis=i), start=window - 1)
            axes.set(ylabel=f"{force} {AXES[i]} [N]", ylim=self.scale.force)
        for axes in panels:
            axes.set_xlim(0, self._seconds)
            axes.tick_params(labelbottom=axes is panels[-1])
        keys = {"target": ORANGE, blue: BLUE, f"mean over {window * TICK_S:g} s": BLACK}
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
        series: Callable[[Footage], AnyArray],
        start: int = 0,
        style: str = "default",
    ) -> None:
        """Draw a series of the footage, whose first value is at the tick `start`.

        The past is drawn in full colour. Unless the footage is still growing, all values are also
        drawn faintly.
        """

        def times(values: AnyArray) -> Float[np.ndarray, "values"]:
            return (np.arange(len(values)) + start + 1) * TICK_S

        def update(tick: int) -> None:
            # self.footage is replaced while it grows, so read the series again.
            past = series(self.footage)[: max(tick + 1 - start, 0)]
            line.set_data(times(past), past)

        if not self._growing:
            values = series(self.footage)
            axes.plot(
                times(values), values, color=colour, linewidth=width, alpha=0.25, drawstyle=style
            )
        (line,) = axes.plot([], [], color=colour, linewidth=width, drawstyle=style)
        self._moving.append((line, update))


def _commanded_angle(footage: Footage) -> AnyArray:
    return footage.command.angle


def _measured_angle(footage: Footage) -> AnyArray:
    return footage.reading.angle


def _force(footage: Footage, axis: int) -> AnyArray:
    return footage.force[:, axis]


def _average(footage: Footage, axis: int) -> AnyArray:
    return footage.average[:, axis]


def _reference(footage: Footage, axis: int | slice = slice(None)) -> np.ndarray:
    """Return the reference of footage that has one, or its component along one axis."""
    assert footage.reference is not None
    return footage.reference[:, axis]


class EpisodeFilm:
    """Draws an episode while its actions are added.

    The plant is simulated a second time, tick by tick. It is pure, so it moves exactly as in the
    task.
    """

    def __init__(
        self, plant: Plant, seconds: float, greatest_reference_n: float, clock: ActionClock
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._limits = Limits(*plant.limits)
        self._seconds = seconds
        self._shoot = jax.jit(partial(shoot, plant))
        self._greatest = np.full(2, greatest_reference_n)
        self._rest: EpisodePart | None = None
        self._actions: list[EpisodePart] = []
        self._picture: Picture | None = None

    def reset(self, state: State, reference: Float[np.ndarray, "2"]) -> None:
        """Start with one tick of a fin at rest, which the first action replaces."""
        self._rest = self._roll(state, rest_command(self._limits), 1, reference)
        self._actions = []

    def add(
        self, state: State, command: Command, ticks: int, reference: Float[np.ndarray, "2"]
    ) -> None:
        """Add an action: the state before it, its command, its duration, and the reference [N]."""
        self._actions.append(self._roll(state, command, ticks, reference))

    def _roll(
        self, state: State, command: Command, ticks: int, reference: Float[np.ndarray, "2"]
    ) -> EpisodePart:
        # Always simulate the longest action, so that one compiled program suffices; a tick does not
        # depend on later ones, which are cut off.
        angle = jnp.full(self._clock.max_ticks, command.angle, jnp.float32)
        velocity = jnp.full(self._clock.max_ticks, command.velocity, jnp.float32)
        commands = Command(angle, velocity)
        recorded = (commands, self._shoot(state, commands))
        command, shots = jax.tree.map(lambda x: np.asarray(x)[:ticks], recorded)
        return command, shots, np.tile(np.asarray(reference, np.float32), (ticks, 1))

    def frame(self) -> Image:
        """Return the image at the end of the last action."""
        parts = self._actions
        if not parts:
            assert self._rest is not None
            parts = [self._rest]
        command, shots, reference = jax.tree.map(lambda *parts: np.concatenate(parts), *parts)
        footage = develop(self._plant, command, shots, reference, self._clock)
        greatest = max_sizes(footage)
        outgrown = greatest > self._greatest
        if self._picture is None or outgrown.any():
            # Twice the required range, so that the scale changes rarely.
            self._greatest = np.where(outgrown, 2 * greatest, self._greatest)
            scale = choose_scale(
                footage, self._greatest, (self._limits.angle_min, self._limits.angle_max)
            )
            is_tank = isinstance(self._plant, Tank)
            where = "the virtual tank" if is_tank else type(self._plant).__name__
            title = f"A soft fin in {where}"
            self._picture = Picture(footage, title, growing=(scale, self._seconds))
        self._picture.footage = footage
        return self._picture.frame(-1)


def _move_cursor(cursor: Line2D, tick: int) -> None:
    cursor.set_xdata([(tick + 1) * TICK_S])


def _filling(x: AxisRange, y: AxisRange) -> tuple[AxisRange, AxisRange]:
    """Extend the shorter range on both sides, so that both ranges fill the panel."""
    width = x[1] - x[0]
    height = y[1] - y[0]
    more_x = max(PANEL * height - width, 0) / 2
    more_y = max(width / PANEL - height, 0) / 2
    return (x[0] - more_x, x[1] + more_x), (y[0] - more_y, y[1] + more_y)


def smooth(points: OutlinePoints) -> Float[np.ndarray, "pieces 2"]:
    """Return a smooth curve through the points (Catmull and Rom 1974)."""
    # Cubic Hermite spline; the slope at each point is the slope between its two neighbours.
    places = np.arange(len(points))
    curve = CubicHermiteSpline(places, points, np.gradient(points, axis=0))
    return np.asarray(curve(np.linspace(0, places[-1], places[-1] * PIECES + 1)))


def fin_outline(
    middle: OutlinePoints, thickness: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "corners 2"]:
    """Return the smoothed outline of a fin with a rounded tip, given its thickness at the points of
    its centre line."""
    line = smooth(middle)
    half = np.interp(np.linspace(0, 1, len(line)), np.linspace(0, 1, len(thickness)), thickness) / 2
    # Unit tangents, and unit normals a quarter turn to their left.
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    offset = half[:, None] * normal
    # Semicircle around the tip, from the left to the right edge, without its end points, which are
    # part of the edges.
    turn = np.linspace(np.pi / 2, -np.pi / 2, 9)[1:-1, None]
    tip = line[-1] + half[-1] * (np.sin(turn) * normal[-1] + np.cos(turn) * along[-1])
    return np.concatenate([line + offset, tip, (line - offset)[::-1]])


def arrow_outline(vector: Float[np.ndarray, "2"], width_m: float) -> Float[np.ndarray, "7 2"]:
    """Return the outline of an arrow that starts at the shaft; short arrows are also thinner, so
    that the arrow vanishes at zero."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0 else np.zeros(2)
    head = min(3.2 * width_m, 0.6 * length)
    # Corners of one side from the shaft to the tip (along, across); the other side is the mirror
    # image.
    far, wide = np.array([(0, 0.5), (length - head, 0.5), (length - head, 1.5), (length, 0)]).T[
        :, :, None
    ]
    across = head / 3.2 * wide * np.array([-along[1], along[0]])
    return np.concatenate([along * far + across, (along * far - across)[2::-1]])
