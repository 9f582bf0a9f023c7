"""Parses the command line's notation for a range of reference forces and for cells, with the
standard library alone."""

import re
from pathlib import Path
from typing import TypeAlias

from softfin.core.errors import ConfigurationError
from softfin.storage.paths import check_readable

CellsSource: TypeAlias = tuple[int, int] | Path | None
"""A lattice of columns and rows, a YAML file, or the paper's cells."""


def read_range(text: str) -> tuple[float, float, float, float]:
    """Parse the four numbers X0,Y0,X1,Y1 [N]; raises ConfigurationError for any other text."""
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigurationError(
            f"--range {text}: not four numbers X0,Y0,X1,Y1 [N]; write for example 0.5,-1.5,3.5,1.5"
        ) from None
    return x0, y0, x1, y1


def read_cells(text: str) -> CellsSource:
    """Find the source of the cells; raises ConfigurationError for any other text, or a missing
    file."""
    if text == "paper":
        return None
    if match := re.fullmatch(r"(\d+)\s*x\s*(\d+)", text.strip()):
        return int(match[1]), int(match[2])
    if Path(text).suffix not in (".yaml", ".yml"):
        raise ConfigurationError(
            f"--cells {text}: neither paper, nor a lattice such as 3x3 (cells along x, cells along "
            "y), nor a .yaml file"
        )
    check_readable(Path(text))
    return Path(text)
