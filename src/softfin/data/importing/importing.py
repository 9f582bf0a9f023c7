"""How recordings of any kind become logs: which column is which, units, signs, clocks; the options of `open_logs`."""

import csv
import difflib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import pydantic

from softfin.core.choices import ForceUnit, TimeUnit
from softfin.core.configuration import Configuration
from softfin.data.importing.names import KINDS, UNITS

CHANNELS = ("time", "command_angle", "command_velocity", "angle", "velocity", "force_x", "force_y")
"""What a log is made of. A recording may lack the velocity; time and commanded velocity, where an option tells them."""

NO_COLUMN = "-"
"""In place of a column's name: the file has none for this channel, whatever its names look like."""

ANGLES = ("command_angle", "command_velocity", "angle", "velocity")
"""The channels that may be in degrees, or of the wrong sign."""

TOPICS = ("command", "joint", "wrench")

FORCE_FRAMES = tuple(
    f"{sx}{x},{sy}{y}" for (x, y), sx, sy in itertools.product((("x", "y"), ("y", "x")), ("", "-"), ("", "-"))
)
"""The ways in which a sensor's axes can be swapped and turned: what is +x and what is +y, in its own axes."""


class ImportConfig(Configuration):
    """What there is to know of recordings that somebody else made; the defaults suit softfin's own logs."""

    columns: dict[str, str] = pydantic.Field(default_factory=dict)
    """Channel: name of its column, as ``angle=position,force_x=Fx``, or ``-`` for none; names that say what they are
    need no such pair."""
    topics: dict[str, str] = pydantic.Field(default_factory=dict)
    """Of a ROS 2 bag: command, joint, wrench; by default /fin/command, /fin/joint_states, /fin/wrench. A joint among
    several is named behind a colon, as ``joint=/joint_states:fin``."""
    rate_hz: float | None = pydantic.Field(default=None, gt=0)
    """Rows a second [Hz], where there is no column of time."""
    velocity_rad_s: float | None = pydantic.Field(default=None, gt=0, le=40)
    """Velocity of all commands [rad/s], where there is no column of it."""
    time_unit: TimeUnit | None = None
    """Of the column of time; by default what its name says, else s."""
    angles: dict[str, str] = pydantic.Field(default_factory=dict)
    """Unit of the angle's channels, as ``deg`` for all or ``command_angle=deg,command_velocity=rpm``; by default what
    their names say, else rad. Of a velocity, deg is deg/s."""
    force_unit: ForceUnit | None = None
    """Of both columns of force; by default what their names say, else N."""
    force: Literal[FORCE_FRAMES] = "x,y"  # type: ignore[valid-type]
    """What is +x (thrust that pushes the robot forward) and what is +y, in the recording's own axes: ``y,-x``."""
    negate: tuple[str, ...] = ()
    """Angle channels of the wrong sign, as ``command_angle``; the velocity goes with its angle where it has a sign."""
    command_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """How much later than the angle's clock the commands were stamped [ms]; they are moved earlier by it."""
    force_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Likewise of the force [ms]."""
    rows_per_log: int | None = pydantic.Field(default=None, ge=2)
    """Where one file holds several logs, end to end; the paper's are 20,000 rows."""
    test: str | None = None
    """Pattern of the files to score on; by default names that begin with test, and what lies in a folder test."""
    gap_s: float = pydantic.Field(default=0.05, gt=0)
    """Longest gap that is bridged by interpolation [s]; a longer one splits the log. 5 samples: a fin at 3 Hz moves
    smoothly for as long."""
    shortest_s: float = pydantic.Field(default=2.0, gt=0)
    """Shortest piece that is kept as a log [s]; the window of the paper's nets is 1 s."""

    @pydantic.field_validator("columns", "topics", mode="before")
    @classmethod
    def _pairs(cls, value: Any) -> Any:
        return _mapping(value) if isinstance(value, str) else value

    @pydantic.field_validator("angles", mode="before")
    @classmethod
    def _units(cls, value: Any) -> Any:
        if isinstance(value, str):
            value = _mapping(value) if "=" in value else dict.fromkeys(ANGLES, value)
        for channel, unit in value.items() if isinstance(value, dict) else ():
            units = [*UNITS["angle"], *(UNITS["velocity"] if KINDS.get(channel) == "velocity" else ())]
            if unit not in units:
                raise ValueError(
                    f"{unit!r} is no unit of angles; say {', '.join(units)}, or of each, as angle=deg,velocity=rpm"
                )
        return value

    @pydantic.field_validator("negate", mode="before")
    @classmethod
    def _list(cls, value: Any) -> Any:
        return tuple(name.strip() for name in value.split(",") if name.strip()) if isinstance(value, str) else value

    @pydantic.field_validator("columns")
    @classmethod
    def _channels(cls, value: dict[str, str]) -> dict[str, str]:
        return _known(value, CHANNELS)

    @pydantic.field_validator("topics")
    @classmethod
    def _roles(cls, value: dict[str, str]) -> dict[str, str]:
        return _known(value, TOPICS)

    @pydantic.field_validator("angles", "negate")
    @classmethod
    def _angular(cls, value: Any) -> Any:
        return _known(value, ANGLES)


Names = TypeVar("Names", bound=Iterable[str])


def _known(names: Names, allowed: Sequence[str]) -> Names:
    for name in names:
        if name not in allowed:
            near = difflib.get_close_matches(name, allowed, n=1)
            raise ValueError(
                f"no {name!r}; did you mean {near[0]!r}?" if near else f"no {name!r} in {', '.join(allowed)}"
            )
    return names


def composed(given: str, then: str) -> str:
    """The one frame of force that does what two do, one after the other."""
    terms = {"x": given.split(",")[0], "y": given.split(",")[1]}
    signed = [("-" if term.startswith("-") else "", terms[term[-1]]) for term in then.split(",")]
    return ",".join((sign + term).replace("--", "") for sign, term in signed)


def _mapping(text: str) -> Mapping[str, str]:
    # As in a CSV file, a pair with a comma of its own stands in quotes.
    pairs = [pair.partition("=") for pair in next(csv.reader([text], skipinitialspace=True), []) if pair.strip()]
    for name, sign, value in pairs:
        if not sign or not value.strip():
            raise ValueError(f"{name.strip()!r} has no value; write NAME=VALUE,NAME=VALUE")
    return {name.strip(): value.strip() for name, _, value in pairs}
