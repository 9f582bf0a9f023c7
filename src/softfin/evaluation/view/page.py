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
"""Unit of the shapes, which are whole numbers: a fifth of a pixel, in few bytes."""


def write_page(path: Path, footage: Footage, title: str) -> None:
    """Write the page."""
    template, script = (
        importlib.resources.files("softfin.evaluation.view").joinpath(name).read_text("utf-8")
        for name in ("page.html.jinja", "page.js")
    )
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template).render(
        title=title,
        shape_known=footage.shape_known,
        asked=footage.reference is not None,
        stream=footage.stream is not None,
        footage=Markup(embedded(to_dict(footage))),
        script=Markup(with_canvas(script)),
    )  # fmt: skip
    artifacts.write_file(path, page)


def to_dict(footage: Footage) -> dict[str, Any]:
    """What the page draws, as plain numbers."""
    series = {
        "force": (footage.reading.force, 3), "mean": (footage.average, 3),
        "reference": (footage.reference, 3), "stream": (footage.stream, 4),
    }  # fmt: skip
    ticks, points = footage.shape.shape[:2]
    return {
        "rate_hz": RATE_HZ,
        "ticks": ticks,
        "points": points,
        "window": WINDOW,
        "trail": TRAIL_TICKS,
        "scale": scale_of(footage)._asdict(),
        "command": _rounded(footage.command.angle, 4),
        "angle": _rounded(footage.reading.angle, 4),
        **{
            f"{name}_{axis}": _rounded(values[:, i], digits)
            for name, (values, digits) in series.items()
            if values is not None
            for i, axis in enumerate(AXES)
        },
        "shape_unit_m": SHAPE_UNIT_M,
        "shape": np.rint(footage.shape / SHAPE_UNIT_M).astype(int).ravel().tolist(),
        "thickness": _rounded(footage.thickness, 5),
    }


def embedded(value: Any) -> str:
    """JSON that may stand in a ``<script>``: no text in it can close the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _rounded(values: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]
