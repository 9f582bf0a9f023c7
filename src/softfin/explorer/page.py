"""The page as one HTML file: template, scripts in order, and the data of controllers and plants."""

import importlib.resources
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
from markupsafe import Markup

from softfin.core.action_clock import ActionClock
from softfin.core.canvas import with_canvas
from softfin.core.quantities import TICK_S
from softfin.storage import artifact as artifacts

SIMULATION = (
    "numbers",
    "profile",
    "surrogate",
    "tank",
    "power",
    "region",
    "feedback",
    "controllers",
    "hand",
    "loop",
)
"""Scripts for computation, in order; they do not need a page."""

DRAWN = ("drawing", "page")
"""Scripts for drawing and input."""


def read_script(*names: str) -> str:
    """Return the given scripts of this folder, concatenated."""
    folder = importlib.resources.files("softfin.explorer")
    return "\n".join(folder.joinpath(f"{name}.js").read_text("utf-8") for name in names)


def write_explorer_page(
    path: Path,
    title: str,
    controllers: Sequence[Mapping[str, object]],
    plants: Sequence[Mapping[str, object]],
) -> None:
    """Write the page. It needs no network connection and can be opened with a double click."""
    template = (
        importlib.resources.files("softfin.explorer").joinpath("page.html.jinja").read_text("utf-8")
    )
    clock = ActionClock.model_validate(controllers[0]["clock"])
    contents = json.dumps(
        {"controllers": controllers, "plants": plants}, separators=(",", ":"), allow_nan=False
    )
    page = (
        jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        .from_string(template)
        .render(
            title=title,
            controllers=controllers,
            plants=plants,
            surrogate=any(plant["kind"] == "surrogate" for plant in plants),
            grid=any(controller["kind"] == "grid" for controller in controllers),
            window_s=f"{clock.window_ticks * TICK_S:g}",
            # Escaped so that no text in the data can close the script element.
            contents=Markup(contents.replace("<", "\\u003c")),
            script=Markup(
                with_canvas(f'"use strict";\n/* canvas.js */\n{read_script(*SIMULATION, *DRAWN)}')
            ),
        )
    )
    artifacts.write_file(path, page)
