"""Import options of `open_logs`: columns, units, signs and clocks of third-party recordings."""

import csv
import shlex
from typing import Annotated, Any, Literal, get_args

import pydantic

from softfin.core.choices import ForceUnit, TimeUnit
from softfin.core.configuration import Configuration, option_name
from softfin.core.option_types import NAMES, PAIRS
from softfin.data.importing.names import KINDS, UNITS, Channel, FurtherChannel

NO_COLUMN = "-"
"""Value of --columns for a channel that is not in the file, even if a column name seems to
match."""

AngleChannel = Literal["command_angle", "command_velocity", "angle", "velocity"]

ANGLES: tuple[AngleChannel, ...] = get_args(AngleChannel)
"""Channels with units of angle or angular velocity."""

SignedChannel = Literal["command_angle", "angle", "velocity"]

SIGNED: tuple[SignedChannel, ...] = get_args(SignedChannel)
"""Channels whose sign can be wrong; a commanded velocity is a magnitude."""

Topic = Literal["command", "joint", "wrench", "current"]

FORCE_FRAMES = ("x,y", "x,-y", "-x,y", "-x,-y", "y,x", "y,-x", "-y,x", "-y,-x")
"""Possible orientations of a force sensor: the sensor axes along softfin's +x and +y."""


class ImportConfig(Configuration):
    """How to read recordings; the defaults match softfin's own logs."""

    columns: Annotated[dict[Channel, str], PAIRS] = pydantic.Field(default_factory=dict)
    """Columns of channels, e.g. ``angle=position,force_x=Fx``; ``-`` for none (default: by
    name)."""
    topics: Annotated[dict[Topic, str], PAIRS] = pydantic.Field(default_factory=dict)
    """Topics of a ROS 2 bag, e.g. ``joint=/joint_states:fin`` for one of several joints (default:
    command=/fin/command, joint=/fin/joint_states, wrench=/fin/wrench, current=/fin/current)."""
    stamps: Literal["header", "logging"] = "header"
    """Times of bag messages: from their headers, or of logging if the headers are wrong."""
    rate_hz: float | None = pydantic.Field(default=None, gt=0)
    """Rows per second of files without a time column [Hz]."""
    velocity_rad_s: float | None = pydantic.Field(default=None, gt=0, le=40)
    """Velocity of all commands in files without a velocity column [rad/s]."""
    time_unit: TimeUnit | None = None
    """Unit of the time column (default: from the column name, or s)."""
    angles: Annotated[dict[AngleChannel, str], PAIRS] = pydantic.Field(default_factory=dict)
    """Units of angles, e.g. ``deg`` or ``command_angle=deg,command_velocity=rpm`` (default: by
    name, or rad)."""
    angle_zero: float = pydantic.Field(default=0.0, allow_inf_nan=False)
    """Value of the angle columns at softfin's angle 0, in their unit, e.g. 180."""
    force_unit: ForceUnit | None = None
    """Unit of the force columns (default: from the column names, or N)."""
    force: Literal[FORCE_FRAMES] = "x,y"  # type: ignore[valid-type]
    """Recorded axes along softfin's +x (thrust, which drives the robot forward) and +y."""
    negate: Annotated[tuple[Literal[SignedChannel, FurtherChannel], ...], NAMES] = ()
    """Channels to negate, e.g. ``command_angle``. Negating ``angle`` also negates ``velocity``."""
    command_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Delay of the command timestamps relative to the angle [ms]; softfin removes it."""
    force_lag_ms: float = pydantic.Field(default=0.0, ge=-1000, le=1000)
    """Delay of the force timestamps relative to the angle [ms]; softfin removes it."""
    rows_per_log: int | None = pydantic.Field(default=None, ge=2)
    """Number of rows per log in files that contain several logs end to end; 20000 in the paper."""
    test: str | None = None
    """Pattern for the names of test logs (default: names that start with test, and files in a
    folder named test)."""
    # Five samples at 100 Hz; within 50 ms, the motion of a fin at 3 Hz is smooth.
    gap_s: float = pydantic.Field(default=0.05, gt=0)
    """Longest gap to interpolate [s]; a longer gap splits the log."""
    shortest_s: float = pydantic.Field(default=2.0, gt=0)
    """Shortest piece to keep as a log [s]; the paper's networks need a window of 1 s."""

    ignore_errors: Annotated[tuple[str, ...], NAMES] = ()
    """Names of errors that do not stop a fit or an import, e.g. ``force-lag,stuck`` or ``all``."""

    @pydantic.field_validator(
        "columns", "topics", "angles", "negate", "ignore_errors", mode="before"
    )
    @classmethod
    def _parsed(cls, value: Any, info: Any) -> Any:
        if info.field_name in ("negate", "ignore_errors"):
            names = ",".join([value] if isinstance(value, str) else value).split(",")
            return tuple(name.strip() for name in names if name.strip())
        if not isinstance(value, str):
            return value
        if info.field_name == "angles" and "=" not in value:
            return dict.fromkeys(ANGLES, value)
        pairs = {}
        # Parsed as CSV, so that a column name with a comma can be quoted.
        for part in next(csv.reader([value], skipinitialspace=True), []):
            if part.strip():
                name, _, text = map(str.strip, part.partition("="))
                if not text:
                    raise ValueError(f"{name!r} has no value; use NAME=VALUE,NAME=VALUE")
                pairs[name] = text
        return pairs

    @pydantic.field_validator("angles")
    @classmethod
    def _in_known_units(cls, value: dict[AngleChannel, str]) -> dict[AngleChannel, str]:
        for channel, unit in value.items():
            units = dict(UNITS["angle"])
            if KINDS[channel] == "velocity":
                units |= UNITS["velocity"]
            if unit not in units:
                raise ValueError(
                    f"{unit!r} is not a unit of {channel}; must be one of {', '.join(units)}; for "
                    "different units, use e.g. angle=deg,velocity=rpm"
                )
        return value


def format_options(config: ImportConfig) -> str:
    """Return the options that differ from the defaults, as typed in a shell."""
    words = []
    for field, value in config.model_dump(mode="json", exclude_defaults=True).items():
        if isinstance(value, dict):
            pairs = [f"{name}={text}" for name, text in value.items()]
            # A pair with a comma is quoted, because commas separate pairs.
            value = ",".join(f'"{pair}"' if "," in pair else pair for pair in pairs)
        elif isinstance(value, list):
            value = ",".join(value)
        words.append(f"--{option_name(field)}={shlex.quote(str(value).removesuffix('.0'))}")
    return " ".join(words)


def turned(x: Any, y: Any, frame: str) -> list[Any]:
    """Return the +x and +y components of a force in a frame."""
    source = {"x": x, "y": y, "-x": -x, "-y": -y}
    return [source[term] for term in frame.split(",")]


def compose_frames(given: str, then: str) -> str:
    """Return the frame that is equivalent to applying `given` and then `then`."""
    x, y = turned(1, 2, given)
    both = turned(x, y, then)
    return next(frame for frame in FORCE_FRAMES if turned(1, 2, frame) == both)
