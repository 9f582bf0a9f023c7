"""Types of the parameters of public functions, with their placeholders on the command line.

A parameter is ``Annotated[type, DIR]``, for example; a bool is a flag, a Literal is a choice and a
tuple is a repeatable option.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, get_args

from cyclopts import Parameter, Token

from softfin.core.errors import ConfigurationError

if TYPE_CHECKING:
    from softfin.core.configuration import Settings
    from softfin.core.plant import Plant

    PlantLike: TypeAlias = str | Path | Plant
else:
    # Plants need JAX, whose import would delay help texts; on the command line, a plant is text.
    PlantLike = Any
    Settings = Any

Entry: TypeAlias = Any
"""A folder of a controller, or an object that acts as one; on the command line, it is text."""

PathLike: TypeAlias = str | Path
"""A file or a folder."""

DIR = Parameter(metavar="DIR")
FILE = Parameter(metavar="FILE")
PLANT = Parameter(metavar="PLANT")
DATA = Parameter(metavar="DATA")
RECORDING = Parameter(metavar="RECORDING")
LOGS = Parameter(metavar="LOGS")
CONTROLLER = Parameter(metavar="CONTROLLER")

Force: TypeAlias = tuple[float, float]
"""A force (x, y) [N]."""


def _parse_forces(hint: object, tokens: Sequence[Token]) -> Force | tuple[Force, ...]:
    forces = []
    for token in tokens:
        try:
            x, y = map(float, token.value.split(","))
            if not math.isfinite(x) or not math.isfinite(y):
                raise ValueError
        except ValueError:
            raise ConfigurationError(
                f"{token.keyword} {token.value}: not a force; use X,Y in newtons, e.g. 1,-1"
            ) from None
        forces.append((x, y))
    is_repeated = get_args(hint)[1:] == (...,)
    return tuple(forces) if is_repeated else forces[-1]


FORCE = Parameter(metavar="X,Y", n_tokens=1, converter=_parse_forces)
"""For forces, each typed as X,Y in one word."""


def _keep_text(_: object, tokens: Sequence[Token]) -> str:
    return ",".join(token.value for token in tokens)


PAIRS = Parameter(metavar="NAME=VALUE", n_tokens=1, accepts_keys=False, converter=_keep_text)
"""For a mapping whose class parses NAME=VALUE,NAME=VALUE."""

NAMES = Parameter(metavar="NAME", n_tokens=1, converter=_keep_text)
"""For names whose class parses NAME,NAME."""

RECORDINGS = Parameter(name="*", group="Recordings that softfin did not make")
"""For import options; each is an option of its own."""

CONNECTION = Parameter(name="*", group="Connection to other ROS 2 nodes")
"""For the fields of a connection; each is an option of its own."""

HIDDEN = Parameter(parse=False)
"""For a parameter that cannot be typed, such as `progress`."""

Config: TypeAlias = Annotated[Settings | None, FILE]
"""Configuration of a stage: complete, or changes to the default. On the command line, it is a YAML
file. Each field is also an option, such as ``--excitation.hold-min-s 0.2``, which overrides the
file."""
