"""Style and file formats of all figures, which are readable in greyscale and by colour-blind
readers. No global state.

The colours are the palette of Okabe and Ito (2008), in an order in which neighbours also differ in
lightness.
"""

import contextlib
import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from softfin.storage import artifact as artifacts

BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
BLACK = "#1A1A1A"
GREY = "#767676"

STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "hatch.linewidth": 0.6,
    "savefig.dpi": 150,
    # Text is stored as text, so files are small and searchable and use the reader's font.
    "svg.fonttype": "none",
    # The same figure always produces the same bytes.
    "svg.hashsalt": "softfin",
}


def new_figure(width_in: int | float, height_in: int | float) -> Figure:
    """Return an empty figure with automatic layout; draw in it within the context `styled`."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def styled() -> contextlib.AbstractContextManager[None]:
    """Return the context manager in which figures must be drawn and saved."""
    return matplotlib.rc_context(STYLE)


def save_figure(figure: Figure, file: Path) -> None:
    """Write a figure in the format given by the suffix, ``.png`` or ``.svg``."""
    artifacts.write_file(file, _render(figure, file.suffix[1:]))


def _render(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    with styled():
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(buffer, format=kind, metadata=metadata)
    return buffer.getvalue()
