"""Options of `open_logs`: columns, units, signs and clocks of recordings made by others."""

import csv
from typing import Any, Literal, get_args

import pydantic

from softfin.core.choices import ForceUnit, TimeUnit
from softfin.core.configuration import Configuration
from softfin.data.importing.names import KINDS, UNITS, Channel

NO_COLUMN = "-"
"""Stands for a column that the file does not have, whatever its names look like."""

AngleChannel = Literal["command_angle", "command_velocity", "angle", "velocity"]

ANGLES: tuple[AngleChannel, ...] = get_args(AngleChannel)
"""Channels that can be in degrees."""

SignedChannel = Literal["command_angle", "angle", "velocity"]

SIGNED: tuple[SignedChannel, ...] = get_args(SignedChannel)
"""Channels that can have the wrong sign; a commanded velocity is a magnitude."""

Topic = Literal["command", "joint", "wrench"]

FORCE_FRAMES = ("x,y", "x,-y", "-x,y", "-x,-y", "y,x", "y,-x", "-y,x", "-y,-x")
"""The ways in which a sensor's axes can be swapped or reversed: softfin's +x and +y, in the
sensor's axes."""


class ImportConfig(Configuration):
    """How recordings are read; the defaults suit softfin's own logs."""

    columns: dict[Channel, str] = pydantic.Field(default_factory=dict)
    """Column of each channel, such as ``angle=position,force_x=Fx``, or ``-`` for none. Only for
    columns whose names softfin does not recognise."""
    topics: dict[Topic, str] = pydantic.Field(default_factory=dict)
    """Topics of a ROS 2 bag, such as ``joint=/joint_states:fin``, where fin names one joint of
    several (default: command=/fin/command, joint=/fin/joint_states, wrench=/fin/wrench)."""
    rate_hz: float | None = pydantic.Field(default=None, gt=0)
    """Rows per second [Hz], for files without a time column."""
    velocity_rad_s: float | None = pydantic.Field(default=None, gt=0, le=40)
    """Velocity of all commands [rad/s], for files without such a column."""
    time_unit: TimeUnit | None = None
    """Unit of the time column (default: from the name of the column, or s)."""
    angles: dict[AngleChannel, str] = pydantic.Field(default_factory=dict)
    """Unit of all angle channels, such as ``deg``, or of each, such as
    ``command_angle=deg,command_velocity=rpm``; for a velocity, deg means deg/s (default: from the
    names of the columns, or rad)."""
    force_unit: ForceUnit | None = None
    """Unit of the force columns (default: from their names, or N)."""
    force: Literal[FORCE_FRAMES] = "x,y"  # type: ignore[valid-type]
    """Axes of the recording that are softfin's +x (thrust, which drives the robot forward)
    and +y."""
    negate: tuple[SignedChannel, ...] = ()
    """Angle channels with the wrong sign, such as ``command_angle``. A signed velocity also changes
    its sign."""
    command_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Delay of the time stamps of the commands relative to the angle [ms]; softfin removes it."""
    force_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Delay of the time stamps of the force relative to the angle [ms]; softfin removes it."""
    rows_per_log: int | None = pydantic.Field(default=None, ge=2)
    """Rows per log, for files with several logs end to end; 20000 in the paper."""
    test: str | None = None
    """Pattern for the names of test logs (default: names that start with test, and all files in a
    folder test)."""
    # Five samples: the motion of a fin at 3 Hz is smooth for that long.
    gap_s: float = pydantic.Field(default=0.05, gt=0)
    """Longest gap to fill by interpolation [s]; a longer gap splits the log."""
    shortest_s: float = pydantic.Field(default=2.0, gt=0)
    """Shortest piece to keep as a log [s]; the window of the paper's networks is 1 s."""

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
        pairs = {}
        # As in a CSV file, a pair that contains a comma is quoted.
        for part in next(csv.reader([value], skipinitialspace=True), []):
            if part.strip():
                name, _, text = map(str.strip, part.partition("="))
                if not text:
                    raise ValueError(f"{name!r} has no value; write NAME=VALUE,NAME=VALUE")
                pairs[name] = text
        return pairs

    @pydantic.field_validator("angles")
    @classmethod
    def _in_known_units(cls, value: dict[AngleChannel, str]) -> dict[AngleChannel, str]:
        for channel, unit in value.items():
            units = list(UNITS["angle"])
            if KINDS[channel] == "velocity":
                units += UNITS["velocity"]
            if unit not in units:
                raise ValueError(
                    f"{unit!r} is not a unit of angles; allowed are {', '.join(units)}, or of "
                    "each, as angle=deg,velocity=rpm"
                )
        return value


def turned(x: Any, y: Any, frame: str) -> list[Any]:
    """Convert a force to another frame: its +x and +y."""
    source = {"x": x, "y": y, "-x": -x, "-y": -y}
    return [source[term] for term in frame.split(",")]


def compose_frames(given: str, then: str) -> str:
    """Return the frame that combines two frames, one after the other."""
    x, y = turned(1, 2, given)
    both = turned(x, y, then)
    return next(frame for frame in FORCE_FRAMES if turned(1, 2, frame) == both)
