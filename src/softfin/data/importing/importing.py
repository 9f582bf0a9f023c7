"""Options of `open_logs`: which column is which, units, signs, clocks of recordings that somebody
else made."""

import csv
import itertools
from typing import Any, Literal, get_args

import pydantic

from softfin.core.choices import ForceUnit, TimeUnit
from softfin.core.configuration import Configuration
from softfin.data.importing.names import KINDS, UNITS, Channel

NO_COLUMN = "-"
"""Given as a column's name where the file has none for this channel, whatever its names look
like."""

AngleChannel = Literal["command_angle", "command_velocity", "angle", "velocity"]

ANGLES: tuple[AngleChannel, ...] = get_args(AngleChannel)
"""Channels that may be in degrees."""

SignedChannel = Literal["command_angle", "angle", "velocity"]

SIGNED: tuple[SignedChannel, ...] = get_args(SignedChannel)
"""Channels that may be of the wrong sign; a commanded velocity is a magnitude."""

Topic = Literal["command", "joint", "wrench"]

FORCE_FRAMES = tuple(
    f"{sx}{x},{sy}{y}"
    for (x, y), sx, sy in itertools.product((("x", "y"), ("y", "x")), ("", "-"), ("", "-"))
)
"""The ways in which a sensor's axes can be swapped and turned: what is +x and what is +y, in its
own axes."""


class ImportConfig(Configuration):
    """How recordings are read; the defaults suit softfin's own logs."""

    columns: dict[Channel, str] = pydantic.Field(default_factory=dict)
    """Name of each channel's column, as ``angle=position,force_x=Fx``, or ``-`` for none; columns
    whose names are understood need no such pair."""
    topics: dict[Topic, str] = pydantic.Field(default_factory=dict)
    """Topics of a ROS 2 bag: command, joint, wrench; by default /fin/command, /fin/joint_states,
    /fin/wrench. A joint among several is named behind a colon, as ``joint=/joint_states:fin``."""
    rate_hz: float | None = pydantic.Field(default=None, gt=0)
    """Rows per second [Hz], where no column holds the time."""
    velocity_rad_s: float | None = pydantic.Field(default=None, gt=0, le=40)
    """Velocity of all commands [rad/s], where no column holds it."""
    time_unit: TimeUnit | None = None
    """Unit of the column of time; by default the one in its name, else s."""
    angles: dict[AngleChannel, str] = pydantic.Field(default_factory=dict)
    """Unit of the angle's channels, as ``deg`` for all or
    ``command_angle=deg,command_velocity=rpm``; by default the ones in their names, else rad. For a
    velocity, deg means deg/s."""
    force_unit: ForceUnit | None = None
    """Unit of both columns of force; by default the one in their names, else N."""
    force: Literal[FORCE_FRAMES] = "x,y"  # type: ignore[valid-type]
    """Axes of the recording that are +x (thrust that pushes the robot forward) and +y: ``y,-x``."""
    negate: tuple[SignedChannel, ...] = ()
    """Angle channels of the wrong sign, as ``command_angle``; the velocity goes with its angle
    where it has a sign."""
    command_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Time by which the commands were stamped later than the angle [ms]; they are moved earlier by
    it."""
    force_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Time by which the force was stamped later than the angle [ms]; it is moved earlier by it."""
    rows_per_log: int | None = pydantic.Field(default=None, ge=2)
    """Rows of each log where one file holds several, end to end; the paper's are 20,000 rows."""
    test: str | None = None
    """Pattern of the files that are test logs; by default names that begin with test, and all in a
    folder test."""
    gap_s: float = pydantic.Field(default=0.05, gt=0)
    """Longest gap that is bridged by interpolation [s]; a longer one splits the log. 5 samples: a
    fin at 3 Hz moves smoothly for as long."""
    shortest_s: float = pydantic.Field(default=2.0, gt=0)
    """Shortest piece that is kept as a log [s]; the window of the paper's networks is 1 s."""

    @pydantic.field_validator("columns", "topics", "angles", "negate", mode="before")
    @classmethod
    def _parsed(cls, value: Any, info: Any) -> Any:
        if info.field_name == "negate":
            names = ",".join([value] if isinstance(value, str) else value).split(",")
            return tuple(name.strip() for name in names if name.strip())
        if not isinstance(value, str):
            return value
        if info.field_name == "angles" and "=" not in value:
            return dict.fromkeys(ANGLES, value)
        # As in a CSV file, a pair with a comma of its own stands in quotes.
        parts = [
            part.strip()
            for part in next(csv.reader([value], skipinitialspace=True), [])
            if part.strip()
        ]
        if info.field_name == "negate":
            return tuple(parts)
        pairs = [part.partition("=") for part in parts]
        for name, _, text in pairs:
            if not text.strip():
                raise ValueError(f"{name.strip()!r} has no value; write NAME=VALUE,NAME=VALUE")
        return {name.strip(): text.strip() for name, _, text in pairs}

    @pydantic.field_validator("angles")
    @classmethod
    def _in_known_units(cls, value: dict[AngleChannel, str]) -> dict[AngleChannel, str]:
        for channel, unit in value.items():
            units = [*UNITS["angle"], *(UNITS["velocity"] if KINDS[channel] == "velocity" else ())]
            if unit not in units:
                raise ValueError(
                    f"{unit!r} is not a unit of angles; allowed are {', '.join(units)}, or of "
                    "each, as angle=deg,velocity=rpm"
                )
        return value


def turned(x: Any, y: Any, frame: str) -> list[Any]:
    """Take a force in another frame: its +x and +y."""
    source = {"x": x, "y": y, "-x": -x, "-y": -y}
    return [source[term] for term in frame.split(",")]


def compose_frames(given: str, then: str) -> str:
    """Frame of force that does what two frames do, one after the other."""
    x, y = turned(1, 2, given)
    both = turned(x, y, then)
    return next(frame for frame in FORCE_FRAMES if turned(1, 2, frame) == both)
