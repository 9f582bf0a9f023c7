"""The script that all pages with a canvas share; each page contains a copy."""

import importlib.resources

MARK = "/* canvas.js */"


def with_canvas(page: str) -> str:
    """A page or its script, with the shared script inserted at the marker."""
    return page.replace(
        MARK, importlib.resources.files("softfin.core").joinpath("canvas.js").read_text("utf-8")
    )
