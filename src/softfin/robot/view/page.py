"""Write a trial as a self-contained HTML page with a three-dimensional animation; the page includes
three.js (MIT licence)."""

import base64
import importlib.resources
import json
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.canvas import with_canvas
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ, AnyArray
from softfin.robot.description import WRENCH_AXES, RobotConfig
from softfin.robot.trial import Record
from softfin.storage import artifact as artifacts

FRAME_TICKS = 5
"""Ticks between frames; the page interpolates between them."""

ROBOT_SHAPE_UNIT_M = 1e-4
"""Unit of the fins' shapes, which are stored as integers [m]; finer than a pixel, but compact."""

FIN_SPAN_M = 0.081
"""Width of a fin in the drawing [m]."""


def write_robot_page(path: Path, robot: RobotConfig, record: Record, title: str) -> None:
    """Write the page, which works offline."""
    folder = importlib.resources.files("softfin.robot.view")
    template = folder.joinpath("page.html.jinja").read_text("utf-8")
    script = folder.joinpath("page.js").read_text("utf-8")
    library = base64.b64encode(folder.joinpath("three.module.min.js").read_bytes()).decode()
    trial = json.dumps(record_to_dict(robot, record), separators=(",", ":"), allow_nan=False)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    page = environment.from_string(template).render(
        title=title,
        trial=Markup(trial),
        library=Markup(library),
        script=Markup(with_canvas(script)),
    )
    artifacts.write_file(path, page)


def record_to_dict(robot: RobotConfig, record: Record) -> JsonObject:
    """Return the page's data as plain numbers; series are flattened row by row."""
    frames = np.arange(0, len(record.time), FRAME_TICKS)
    # The last tick of an action still belongs to it.
    actions = np.minimum(
        (record.time[frames] * PAPER_CLOCK.rate_hz - 1e-6).astype(int), len(record.asked) - 1
    )
    series = {
        "position": _rounded(record.body.position[frames], 4),
        "attitude": _rounded(record.body.attitude[frames], 5),
        "target": _rounded(record.target_position[frames], 4),
        "asked": _rounded(record.asked[actions], 3),
        "driven": _rounded(_recent_mean(record.fin_wrench)[frames], 3),
        "off_cm": _rounded(100 * record.position_error()[frames], 2),
        "tilt_deg": _rounded(np.degrees(record.attitude_error()[frames]), 2),
        "given_up": _rounded(record.given_up[actions].astype(int), 0),
    }
    fins = [
        {
            "name": name,
            "place": list(fin.position_m),
            "axes": fin.axes().ravel().round(6).tolist(),
            "shaft": list(fin.shaft_axis),
        }
        for name, fin in robot.fins.items()
    ]
    shapes = record.shapes[frames]
    return {
        "rate_hz": RATE_HZ / FRAME_TICKS,
        "frames": len(frames),
        "axes": WRENCH_AXES,
        "size": robot.size_m,
        "fins": fins,
        "span": FIN_SPAN_M,
        **series,
        "shape_unit": ROBOT_SHAPE_UNIT_M,
        "points": shapes.shape[2],
        "shapes": np.rint(shapes / ROBOT_SHAPE_UNIT_M).astype(int).ravel().tolist(),
    }


def _rounded(values: AnyArray, digits: int) -> list[float]:
    return [round(float(x), digits) for x in np.ravel(values)]


def _recent_mean(wrench: np.ndarray) -> np.ndarray:
    """Return the mean over the two strokes before each tick, which is the net effect of the fins on
    the body."""
    ticks = round(2 * RATE_HZ / PAPER_CLOCK.rate_hz)
    # Running mean from differences of the cumulative sum.
    total = np.cumsum(np.concatenate([np.zeros((1, 6)), wrench]), axis=0)
    end = np.arange(len(wrench)) + 1
    start = np.maximum(end - ticks, 0)
    return np.asarray((total[end] - total[start]) / (end - start)[:, None])
