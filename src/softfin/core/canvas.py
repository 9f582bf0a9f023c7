"""Pages that draw on a canvas share a script, which each of them has inline."""

import importlib.resources

MARK = "/* canvas.js */"


def with_canvas(page: str) -> str:
    """A page, or the script of one, with the shared script where its mark is."""
    return page.replace(
        MARK, importlib.resources.files("softfin.core").joinpath("canvas.js").read_text("utf-8")
    )
