"""Types of the parameters of public functions, with their placeholders on the command line.

A parameter is ``Annotated[type, DIR]``, for example; a bool is a flag, a Literal is a choice and a
tuple is a repeatable option.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter

if TYPE_CHECKING:
    from softfin.core.configuration import Settings
    from softfin.core.plant import Plant

    PlantLike: TypeAlias = str | Plant
else:
    # A plant needs JAX, which a command's help must not wait for; only names can be typed.
    PlantLike = str
    Settings = str

PathLike: TypeAlias = str | Path
"""A file or a folder."""

DIR = Parameter(metavar="DIR")
FILE = Parameter(metavar="FILE")
PLANT = Parameter(metavar="PLANT")
HIDDEN = Parameter(parse=False)
"""For a parameter that cannot be typed, such as `progress`."""

Config: TypeAlias = Annotated[Settings | None, FILE]
"""Configuration of a stage: complete, or changes of the default. On the command line, a YAML file;
each field is also an option, such as ``--excitation.hold-min-s 0.2``, and wins over the file."""
