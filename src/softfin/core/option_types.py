"""Types of the parameters of public functions, with their placeholders on the command line.

A parameter is ``Annotated[type, DIR]``, for example; a bool is a flag, a Literal is a choice and a
tuple is a repeatable option.
"""

from pathlib import Path
from typing import TypeAlias

from cyclopts import Parameter

PathLike: TypeAlias = str | Path
"""A file or a folder."""

DIR = Parameter(metavar="DIR")
FILE = Parameter(metavar="FILE")
PLANT = Parameter(metavar="PLANT")
HIDDEN = Parameter(parse=False)
"""For a parameter that cannot be typed, such as `progress`."""
