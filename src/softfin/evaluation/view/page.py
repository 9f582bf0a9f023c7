"""A footage as one self-contained HTML page that plays it: canvas and plain JavaScript, nothing fetched."""

import importlib.resources
import json
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from softfin.core.action_clock import WINDOW
from softfin.core.canvas import with_canvas
from softfin.core.quantities import AXES, RATE_HZ
from softfin.evaluation.view.footage import Footage
from softfin.evaluation.view.scale import TRAIL_TICKS, scale_of
from softfin.storage import artifact as artifacts

SHAPE_UNIT_M = 1e-4
"""Shapes are whole numbers of this: a fifth of a pixel, in few bytes."""


def write_page(path: Path, footage: Footage, title: str) -> None:
    """Write the page."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    page = environment.from_string(_part("page.html.jinja")).render(
        title=title,
        shape_known=footage.shape_known,
        asked=footage.reference is not None,
        stream=footage.stream is not None,
        footage=Markup(embedded(described(footage))),
        script=Markup(with_canvas(_part("page.js"))),
    )
    artifacts.write_file(path, page)


def described(footage: Footage) -> dict[str, Any]:
    """What the page needs to know, as plain numbers."""
    scale = scale_of(footage)
    ticks, points = footage.shape.shape[:2]
    described = {
        "rate_hz": RATE_HZ,
        "ticks": ticks,
        "points": points,
        "window": WINDOW,
        "trail": TRAIL_TICKS,
        "scale": scale._asdict(),
        "command": _rounded(footage.command.angle, 4),
        "angle": _rounded(footage.reading.angle, 4),
        **{f"force_{axis}": _rounded(footage.reading.force[:, i], 3) for i, axis in enumerate(AXES)},
        **{f"mean_{axis}": _rounded(footage.average[:, i], 3) for i, axis in enumerate(AXES)},
        "shape_unit_m": SHAPE_UNIT_M,
        "shape": np.rint(footage.shape / SHAPE_UNIT_M).astype(int).ravel().tolist(),
        "thickness": _rounded(footage.thickness, 5),
    }
    if footage.reference is not None:
        described |= {f"reference_{axis}": _rounded(footage.reference[:, i], 3) for i, axis in enumerate(AXES)}
    if footage.stream is not None:
        described |= {f"stream_{axis}": _rounded(footage.stream[:, i], 4) for i, axis in enumerate(AXES)}
    return described


def embedded(value: Any) -> str:
    """JSON that may stand in a ``<script>``: no text in it can close the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _rounded(values: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]


def _part(name: str) -> str:
    return importlib.resources.files("softfin.evaluation.view").joinpath(name).read_text("utf-8")
