"""Write footage as a GIF or PNG (with Pillow), or as a self-contained HTML page that plays it."""

import importlib.resources
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import jinja2
import numpy as np
import PIL.Image
from markupsafe import Markup

from softfin.core.canvas import with_canvas
from softfin.core.json_object import JsonObject
from softfin.core.quantities import AXES, RATE_HZ, TICK_S
from softfin.evaluation.view.footage import Footage, choose_scale, max_sizes
from softfin.evaluation.view.picture import TRAIL_TICKS, Picture
from softfin.gaits.reachable import force_decimals
from softfin.storage import artifact as artifacts

ReportPart = Callable[[float], None]
"""Function that is called with the completed fraction (0 .. 1)."""

SHAPE_UNIT_M = 1e-4
"""Unit of the shapes in a page [m], which are stored as integers to keep the page small; about a
fifth of a pixel."""


def shown_ticks(ticks: int, frames_per_second: int) -> range:
    """Return the ticks to show in real time; the last tick is always included."""
    step = RATE_HZ // frames_per_second
    return range((ticks - 1) % step, ticks, step)


def write_gif(path: Path, picture: Picture, frames_per_second: int, report: ReportPart) -> None:
    """Write all frames as a loop; they share a palette, so that static parts take no space."""
    ticks = shown_ticks(len(picture.footage.shape), frames_per_second)
    # By the last frame, all traces are drawn, so it contains all colours.
    palette = PIL.Image.fromarray(picture.frame(-1)).quantize(method=PIL.Image.Quantize.MAXCOVERAGE)

    def quantized_frames() -> Iterator[PIL.Image.Image]:
        for count, tick in enumerate(ticks, start=1):
            frame = PIL.Image.fromarray(picture.frame(tick))
            yield frame.quantize(palette=palette, dither=PIL.Image.Dither.NONE)
            report(count / len(ticks))

    first, *others = quantized_frames()
    buffer = io.BytesIO()
    # Browsers slow down a GIF whose frames are shorter than 2 hundredths of a second.
    first.save(
        buffer,
        "GIF",
        save_all=True,
        append_images=others,
        duration=1000 // frames_per_second,
        loop=0,
    )
    artifacts.write_file(path, buffer.getvalue())


def write_png(path: Path, picture: Picture) -> None:
    """Write the last frame."""
    buffer = io.BytesIO()
    PIL.Image.fromarray(picture.frame(-1)).save(buffer, "PNG", optimize=True)
    artifacts.write_file(path, buffer.getvalue())


def write_page(path: Path, footage: Footage, title: str) -> None:
    """Write a page with a canvas and plain JavaScript; it needs no network."""
    folder = importlib.resources.files("softfin.evaluation.view")
    template = folder.joinpath("page.html.jinja").read_text("utf-8")
    script = folder.joinpath("page.js").read_text("utf-8")
    page = (
        jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        .from_string(template)
        .render(
            title=title,
            shape_known=footage.shape_known,
            window_s=f"{footage.clock.window_ticks * TICK_S:g}",
            asked=footage.reference is not None,
            force_known=footage.true_force is not None,
            footage=Markup(json.dumps(to_dict(footage), separators=(",", ":"), allow_nan=False)),
            script=Markup(with_canvas(script)),
        )
    )
    artifacts.write_file(path, page)


def to_dict(footage: Footage) -> JsonObject:
    """Return the data of a page as plain numbers."""
    # Values with their number of decimals, which are limited to keep the page small.
    decimals = max(force_decimals(float(max_sizes(footage)[0])), 2)
    series = {"command": (footage.command.angle, 4), "angle": (footage.reading.angle, 4)}
    vectors = {"force": footage.force, "mean": footage.average, "reference": footage.reference}
    for i, axis in enumerate(AXES):
        for name, vector in vectors.items():
            if vector is not None:
                series[f"{name}_{axis}"] = (vector[:, i], decimals + 1)
    series["thickness"] = (footage.thickness, 5)
    rounded = {}
    for name, (values, digits) in series.items():
        rounded[name] = [round(float(value), digits) for value in values]
    ticks, points = footage.shape.shape[:2]
    return {
        "rate_hz": RATE_HZ,
        "ticks": ticks,
        "force_known": footage.true_force is not None,
        "points": points,
        "window": footage.clock.window_ticks,
        "trail": TRAIL_TICKS,
        "scale": choose_scale(footage)._asdict(),
        "decimals": decimals,
        **rounded,
        "shape_unit_m": SHAPE_UNIT_M,
        "shape": np.rint(footage.shape / SHAPE_UNIT_M).astype(int).ravel().tolist(),
    }
