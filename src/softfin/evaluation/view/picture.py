"""One frame after the other of a footage, drawn by Matplotlib: what stays is drawn once, what moves over a copy of it.

A footage goes in, images of ``(height, width, 3)`` bytes come out; `video` writes them.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon

from softfin.core.action_clock import WINDOW
from softfin.core.quantities import AXES, TICK_S
from softfin.evaluation.view.footage import Footage
from softfin.evaluation.view.outline import arrow_outline, fin_outline
from softfin.evaluation.view.scale import TRAIL_TICKS, Scale, scale_of
from softfin.storage.figures import BLACK, BLUE, GREY, ORANGE, new_figure, styled

Image = UInt8[np.ndarray, "height width 3"]

Values = Callable[[Footage], Any]
"""One value a tick, of a footage."""

WIDTH_IN, HEIGHT_IN = 9.6, 5.2

FIN, WATER, STREAM = "#3E4C59", "#F1F6FA", "#009E73"

LEGEND = {"asked for": ORANGE, "measured": BLUE, "mean over 2 s": BLACK}

PANEL = 0.92
"""Width over height of the part of the tank that is seen, about that of its place in the figure."""

ARROW = 0.035
"""Width of the arrow of the force over the length of the fin."""


class Picture:
    """A figure whose moving parts are set to one tick after the other.

    Of a footage that is still growing, `scale` and the `seconds` of the time axis are given; nothing lies ahead then.
    """

    def __init__(
        self,
        footage: Footage,
        title: str,
        dots_per_inch: int = 100,
        scale: Scale | None = None,
        seconds: float | None = None,
    ) -> None:
        self.footage, self.scale = footage, scale or scale_of(footage)
        self._growing, self._seconds = seconds is not None, seconds or len(footage.shape) * TICK_S
        self._moving: list[Any] = []
        self._lines: list[tuple[Any, Values, int]] = []
        with styled():
            self.figure = new_figure(WIDTH_IN, HEIGHT_IN)
            self.figure.set_dpi(dots_per_inch)
            # As Any, because Matplotlib's canvas has no types.
            self._canvas = cast(Any, FigureCanvasAgg(self.figure))
            grid = self.figure.add_gridspec(3, 2, width_ratios=(1.05, 1))
            self._draw_tank(self.figure.add_subplot(grid[:, 0]), title)
            self._draw_traces([self.figure.add_subplot(grid[row, 1]) for row in range(3)])
            # Laid out once: what moves must not shift what stays.
            self._canvas.draw()
            self.figure.set_layout_engine("none")
            for artist in self._moving:
                artist.set_visible(False)
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self.figure.bbox)
        for artist in self._moving:
            artist.set_visible(True)

    def frame(self, tick: int) -> Image:
        """The picture at a tick, counted from 0."""
        self._set(tick)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            artist.axes.draw_artist(artist)
        return np.array(self._canvas.buffer_rgba())[..., :3]

    def last_frame(self, footage: Footage) -> Image:
        """The picture at the last tick of a footage that has grown."""
        self.footage = footage
        return self.frame(len(footage.shape) - 1)

    def _set(self, tick: int) -> None:
        footage = self.footage
        for ghost, ago in zip(self._ghosts, TRAIL_TICKS, strict=True):
            ghost.set_xy(fin_outline(footage.shape[max(tick - ago, 0)], self.footage.thickness))
        self._fin.set_xy(fin_outline(footage.shape[tick], self.footage.thickness))
        if footage.reference is not None:
            self._set_arrow(self._asked, footage.reference[tick] * self.scale.metres_per_mean_newton)
        self._set_arrow(self._force, footage.reading.force[tick] * self.scale.metres_per_newton)
        mean = footage.average[tick + 1 - WINDOW] if tick + 1 >= WINDOW else np.zeros(2)
        self._set_arrow(self._mean, mean * self.scale.metres_per_mean_newton, 0.5)
        now = (tick + 1) * TICK_S
        self._clock.set_text(f"{now:.2f} s")
        if footage.stream is not None:
            self._set_stream(footage.stream[tick])
        for line, values, start in self._lines:
            passed = values(footage)[: max(tick + 1 - start, 0)]
            line.set_data(_times(passed, start), passed)
        for cursor in self._cursors:
            cursor.set_xdata([now])

    def _set_arrow(self, arrow: Polygon, vector: Any, width: float = 1.0) -> None:
        arrow.set_xy(arrow_outline(np.asarray(vector, float), width * ARROW * self.scale.length_m))

    def _set_stream(self, stream: Any) -> None:
        speed = float(np.hypot(*stream))
        self._stream.set_xy(arrow_outline(
            np.asarray(stream, float) / self.scale.stream_m_s * 0.2 * self.scale.length_m,
            0.5 * ARROW * self.scale.length_m, self._stream_at,
        ))  # fmt: skip
        self._stream_text.set_text(f"stream {speed:.2f} m/s")

    def _draw_tank(self, axes: Axes, title: str) -> None:
        scale = self.scale
        # A band above for clock and keys, and one below where there is a note.
        above = 0.16 * scale.length_m if self.footage.reference is None else 0.27 * scale.length_m
        below = 0.0 if self.footage.shape_known and self.footage.stream is None else 0.16 * scale.length_m
        xlim, ylim = _filling(scale.x, (scale.y[0] - below, scale.y[1] + above))
        axes.set(xlim=xlim, ylim=ylim, aspect="equal", xlabel="x [m], thrust is +x", ylabel="y [m]")
        axes.set_facecolor(WATER)
        axes.grid(color="white", linewidth=1.0)
        axes.set_title(title, weight="bold")
        self._ghosts = [
            self._add(axes, _polygon(FIN, alpha)) for alpha in np.linspace(0.16, 0.04, len(TRAIL_TICKS)).tolist()
        ]
        self._fin = self._add(axes, _polygon(FIN))
        if self.footage.reference is not None:
            self._asked = self._add(axes, _polygon(ORANGE))
        self._force = self._add(axes, _polygon(BLUE, 0.9))
        self._mean = self._add(axes, _polygon(BLACK))
        shaft = Circle((0, 0), 0.025 * scale.length_m, facecolor="white", edgecolor=BLACK, linewidth=1.4)
        self._add(axes, shaft)
        corner: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 10}
        self._clock = axes.text(0.03, 0.96, "", va="top", weight="bold", color=BLACK, **corner)
        self._moving.append(self._clock)
        self._draw_key(axes, xlim[1], ylim[1])
        if not self.footage.shape_known:
            axes.text(0.03, 0.03, "shape not known: drawn straight", color=GREY, **corner)
        if self.footage.stream is not None:
            self._stream_at = (xlim[0] + 0.3 * scale.length_m, ylim[0] + 0.36 * scale.length_m)
            self._stream = self._add(axes, _polygon(STREAM))
            self._stream_text = axes.text(0.03, 0.03, "", color=STREAM, **corner)
            self._moving.append(self._stream_text)

    def _draw_key(self, axes: Axes, right: float, top: float) -> None:
        """Round forces, to measure the arrows by."""
        scale = self.scale
        keys = [(f"force {scale.key_n:g} N", scale.key_n * scale.metres_per_newton, BLUE)]
        if self.footage.reference is not None:
            text = f"asked for, mean {scale.mean_key_n:g} N"
            keys.append((text, scale.mean_key_n * scale.metres_per_mean_newton, BLACK))
        right = right - 0.06 * scale.length_m
        for row, (text, length, colour) in enumerate(keys):
            middle = top - (0.1 + 0.11 * row) * scale.length_m
            axes.plot([right - length, right], [middle, middle], color=colour, linewidth=2.5, solid_capstyle="butt")
            axes.text(right - length - 0.03 * scale.length_m, middle, text, ha="right", va="center", color=colour)

    def _draw_traces(self, panels: Sequence[Axes]) -> None:
        self._cursors = [self._add(axes, axes.axvline(0, color=BLACK, linewidth=0.9)) for axes in panels]
        angle, *forces = panels
        self._trace(angle, lambda footage: footage.command.angle, ORANGE, 1.3, style="steps-pre")
        self._trace(angle, lambda footage: footage.reading.angle, BLUE, 1.3)
        angle.set(ylabel="angle [rad]", ylim=self.scale.angle)
        for i, axes in enumerate(forces):
            if self.footage.reference is not None:
                self._trace(axes, _force("reference", i), ORANGE, 1.6, style="steps-pre")
            self._trace(axes, _force("measured", i), BLUE, 0.9)
            self._trace(axes, _force("average", i), BLACK, 1.8, WINDOW - 1)
            axes.set(ylabel=f"force {AXES[i]} [N]", ylim=self.scale.force)
        for axes in panels:
            axes.set_xlim(0, self._seconds)
            axes.tick_params(labelbottom=axes is panels[-1])
        legend = [Line2D([], [], color=colour, linewidth=2, label=label) for label, colour in LEGEND.items()]
        angle.legend(handles=legend, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1,
                     handlelength=1.4, columnspacing=1.2)  # fmt: skip
        panels[-1].set_xlabel("time [s]")
        self.figure.align_ylabels(list(panels))

    def _trace(
        self, axes: Axes, values: Values, colour: str, width: float, start: int = 0, style: str = "default"
    ) -> None:
        """What has passed in full, and the whole of it faint, where that is known; `start` is its first tick."""
        if not self._growing:
            whole = values(self.footage)
            axes.plot(_times(whole, start), whole, color=colour, linewidth=width, alpha=0.25, drawstyle=style)
        (line,) = axes.plot([], [], color=colour, linewidth=width, drawstyle=style)
        self._moving.append(line)
        self._lines.append((line, values, start))

    def _add(self, axes: Axes, artist: Any) -> Any:
        axes.add_artist(artist)
        self._moving.append(artist)
        return artist


def _force(kind: Literal["reference", "measured", "average"], axis: int) -> Values:
    def values(footage: Footage) -> Any:
        return (footage.reading.force if kind == "measured" else getattr(footage, kind))[:, axis]

    return values


def _times(values: Any, start: int) -> Float[np.ndarray, " ticks"]:
    return (np.arange(len(values)) + start + 1) * TICK_S


def _polygon(colour: str, alpha: float = 1.0) -> Polygon:
    return Polygon(np.zeros((3, 2)), closed=True, facecolor=colour, edgecolor="none", alpha=alpha)


def _filling(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Both ranges, the one that is too short for the shape of the panel made longer at both ends."""
    width, height = x[1] - x[0], y[1] - y[0]
    more_x, more_y = max(PANEL * height - width, 0) / 2, max(width / PANEL - height, 0) / 2
    return (x[0] - more_x, x[1] + more_x), (y[0] - more_y, y[1] + more_y)
