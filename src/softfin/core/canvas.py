"""The script shared by all pages with a canvas; each page contains a copy."""

import importlib.resources

MARK = "/* canvas.js */"


def with_canvas(page: str) -> str:
    """Insert the shared script into a page or its script, at the marker."""
    return page.replace(
        MARK, importlib.resources.files("softfin.core").joinpath("canvas.js").read_text("utf-8")
    )
