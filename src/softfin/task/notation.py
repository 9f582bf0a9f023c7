"""Parses the command line's notation for ranges of reference forces and for cells, using only the
standard library."""

import re
from pathlib import Path
from typing import TypeAlias

from softfin.core.errors import ConfigurationError
from softfin.storage.paths import check_readable

CellsSource: TypeAlias = tuple[int, int] | Path | None
"""Source of cells: a uniform grid of (columns, rows), a YAML file, or None for the paper's
cells."""


def read_range(text: str) -> tuple[float, float, float, float]:
    """Parse the four numbers X0,Y0,X1,Y1 [N]; raises ConfigurationError for any other text."""
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigurationError(
            f"--range {text}: must be paper or four numbers X0,Y0,X1,Y1 in newtons, e.g. 1,-1,2,1"
        ) from None
    return x0, y0, x1, y1


def read_cells(text: str) -> CellsSource:
    """Parse the source of the cells; raises ConfigurationError for any other text, and for a
    missing file."""
    if text == "paper":
        return None
    if match := re.fullmatch(r"(\d+)\s*x\s*(\d+)", text.strip()):
        return int(match[1]), int(match[2])
    if Path(text).suffix not in (".yaml", ".yml"):
        raise ConfigurationError(
            f"--cells {text}: must be paper, a grid such as 3x3 (cells along x, cells along y), or "
            "a .yaml file"
        )
    check_readable(Path(text))
    return Path(text)
