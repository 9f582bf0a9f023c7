"""Assigns columns to channels, and converts the units and axes of a recording to softfin's.

The user's options take precedence, then softfin's own column names, then names that `read_name`
recognizes. If two columns could be the same channel, neither is used, and the error message
suggests an option for the choice. Every column with a different name from softfin's own is reported
with its unit.
"""

import difflib
import shlex
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import LogError, NotALogError
from softfin.data.importing.importing import NO_COLUMN, ImportConfig, turned
from softfin.data.importing.names import (
    CHANNELS,
    FURTHER,
    KINDS,
    OWN_NAMES,
    ROSTOPIC_TIME,
    SI,
    UNITS,
    read_name,
    split_unit,
    split_unknown_unit,
    unit_factor,
)

MAX_LISTED_COLUMNS = 12
"""Maximum number of column names in a message."""


class Column(NamedTuple):
    """The column from which a channel is read."""

    name: str
    unit: str
    """Unit of the values."""
    is_unit_stated: bool
    """Whether the name or an option states the unit; otherwise the SI unit is assumed."""
    unknown_unit: str = ""
    """Unit in the name that softfin does not know, unless an option states the unit."""


def choose_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, Column]:
    """Find the column of each channel; raises LogError, with the option to use, if the choice is
    ambiguous for a channel of every log."""
    own = [name for name in OWN_NAMES if name in names and OWN_NAMES[name] not in config.columns]
    found = {OWN_NAMES[name]: name for name in own}
    found |= _mapped_columns(names, config, source)
    # Channels with one value for the entire file are not looked up by name.
    options = {"time": config.rate_hz, "command_velocity": config.velocity_rad_s}
    stated = [channel for channel, value in options.items() if value is not None]
    decided = {*found, *config.columns, *stated}
    found |= _recognized_columns(names, list(found.values()), decided, source)
    settled = {*found, *stated, "velocity"}
    if missing := [channel for channel in CHANNELS if channel not in settled]:
        is_log = bool(found.keys() - {"time", *FURTHER})
        raise _missing_error(names, missing, source, LogError if is_log else NotALogError)
    columns = {}
    for channel in (*CHANNELS, *FURTHER):
        if channel in found:
            columns[channel] = _column(channel, found[channel], config)
            # Times may also be text, such as 10:30:00, whatever unit the column name ends in.
            if channel != "time":
                check_unit(channel, columns[channel], source)
    return columns


def _column(channel: str, name: str, config: ImportConfig) -> Column:
    kind = KINDS[channel]
    unit = stated_unit(channel, config) or split_unit(name, kind)[1]
    if unit is not None:
        return Column(name, unit, True)
    unknown = split_unknown_unit(name, kind)
    rest, _, last = name.replace("_", " ").rpartition(" ")
    if unknown is None and last.isalpha() and read_name(rest) and not read_name(name):
        unknown = rest, last
    return Column(name, SI[kind], False, unknown[1] if unknown else "")


def check_unit(channel: str, column: Column, source: str) -> None:
    """Raise LogError if the name of a column states a unit that softfin does not know."""
    if not column.unknown_unit:
        return
    kind = KINDS[channel]
    options = {
        "time": "--time-unit UNIT or --rate 100",
        "force": "--force-unit UNIT",
        "angle": f"--angles {channel}=UNIT",
        "velocity": f"--angles {channel}=UNIT",
    }
    fix = "convert the column"
    if kind in options:
        fix += f", or state its unit with {options[kind]}"
    raise LogError(
        f"{source}: column {column.name!r}: unknown unit {column.unknown_unit!r} for {channel}; "
        f"known units are {', '.join(UNITS[kind])}; {fix}"
    )


def _mapped_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, str]:
    """Return the columns assigned by the option --columns."""
    mapped: dict[str, str] = {}
    for channel, name in config.columns.items():
        if name != NO_COLUMN:
            _check_column(names, name, f"--columns {channel}={name}", source)
            mapped[channel] = name
    return mapped


def _check_column(names: Sequence[str], name: str, option: str, source: str) -> None:
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise LogError(f"{source}: {option}: no such column; {hint}the file has {_listed(names)}")


def _recognized_columns(
    names: Sequence[str],
    taken: Collection[str],
    decided: Collection[str],
    source: str,
) -> dict[str, str]:
    """Return the columns recognized by name, for channels that are not yet decided."""
    candidates: dict[str, list[str]] = {}
    in_unknown_units: dict[str, list[str]] = {}
    for name in names:
        channel, is_known = _channel_and_unit(name)
        if name not in taken and channel and channel not in decided:
            group = candidates if is_known else in_unknown_units
            group.setdefault(channel, []).append(name)
    recognized = {}
    for channel, several in (in_unknown_units | candidates).items():
        if channel == "command_velocity":
            several = _preferred_velocities(several)
        if ROSTOPIC_TIME in several:
            several = [ROSTOPIC_TIME]
        if len(several) > 1 and channel in FURTHER:
            continue
        if len(several) > 1:
            raise LogError(
                f"{source}: {channel} could be {_listed(several, ' or ')}; choose one with "
                f"--columns {_quoted(channel, several[0])}"
            )
        recognized[channel] = several[0]
    return recognized


def _channel_and_unit(name: str) -> tuple[str, bool]:
    """Return the channel for a column name (empty if there is none), and whether its unit is
    known."""
    read = read_name(name)
    if read is not None:
        channel, unit = read
        # A torque or current without a unit may be a drive register in counts.
        return (channel, True) if channel in CHANNELS or unit is not None else ("", False)
    for kind in UNITS:
        unknown = split_unknown_unit(name, kind)
        read = read_name(unknown[0]) if unknown else None
        if read is not None and KINDS[read[0]] == kind and read[0] in CHANNELS:
            return read[0], False
    return "", False


def _missing_error(
    names: Sequence[str], missing: Sequence[str], source: str, error: type[LogError]
) -> LogError:
    others = {
        "time": "; without a time column, use --rate 100 if a row was written every 10 ms",
        "command_velocity": (
            "; without a velocity column, use --velocity 3.1 if all commands had that velocity "
            "[rad/s]"
        ),
    }
    mapping = "=NAME,".join(missing) + "=NAME"
    hints = ""
    for channel in missing:
        hints += others.get(channel, "")
    if any(name.endswith("[0]") for name in names):
        hints += "; columns of lists are split, so NAME may be e.g. action[0]"
    return error(
        f"{source}: no column recognized as {missing[0]} among {_listed(names)} (known units: "
        f"{', '.join(UNITS[KINDS[missing[0]]])}); map it with --columns {mapping}{hints}"
    )


def _preferred_velocities(names: list[str]) -> list[str]:
    """Prefer profile velocities; a goal velocity next to a profile velocity is for the velocity
    mode of the drive."""
    profiles = [name for name in names if "profile" in split_unit(name, "velocity")[0]]
    return profiles or names


def stated_unit(channel: str, config: ImportConfig) -> str | None:
    """Return the unit that the options set for a channel, or None."""
    if channel == "time":
        return config.time_unit
    if channel.startswith("force"):
        return config.force_unit
    # config.angles.get(channel) would be a type error: the keys are literals, and `channel` may be
    # any channel.
    unit = next((unit for angle, unit in config.angles.items() if angle == channel), None)
    if unit is None or unit in UNITS[KINDS[channel]]:
        return unit
    # An angle unit for a velocity, e.g. deg, means that unit per second.
    return f"{unit}/s"


def describe_columns(columns: Mapping[str, Column]) -> str:
    """Describe the columns whose names are not softfin's own; empty if there are none."""
    texts = []
    for channel, column in columns.items():
        if OWN_NAMES.get(column.name) != channel:
            assumed = "" if column.is_unit_stated else " (assumed)"
            texts.append(f"{channel}={column.name!r} in {column.unit}{assumed}")
    return ", ".join(texts)


def converted(
    channels: Mapping[str, Float[np.ndarray, "rows"]],
    config: ImportConfig,
    units: Mapping[str, str] | None = None,
) -> dict[str, Float[np.ndarray, "rows"]]:
    """Convert to SI units and to softfin's signs and axes; additional channels get their column
    names in log files.

    Units are taken from `units`, otherwise from the options; the default is SI.
    """
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or stated_unit(channel, config) or SI[kind]
        if kind == "angle":
            values = values - config.angle_zero
        result[channel] = values if unit == SI[kind] else values * unit_factor(kind, unit)
    # If the angle is reversed, so is its velocity.
    negated = {*config.negate, *(["velocity"] if "angle" in config.negate else [])}
    for channel in negated & result.keys():
        result[channel] = -result[channel]
    if "force_x" in result:
        result["force_x"], result["force_y"] = turned(
            result["force_x"], result["force_y"], config.force
        )
    if {"torque_x", "torque_y"} <= result.keys():
        result["torque_x"], result["torque_y"] = turned(
            result["torque_x"], result["torque_y"], config.force
        )
    else:
        # A torque about only one axis cannot be rotated.
        result = {name: result[name] for name in result if name not in ("torque_x", "torque_y")}
    # A sensor with mirrored x and y axes is upside down, so its z axis is reversed.
    x, y = np.eye(2)
    side = round(float(np.linalg.det(turned(x, y, config.force))))
    for channel in {"force_z", "torque"} & result.keys():
        result[channel] = side * result[channel]
    return {FURTHER.get(channel, channel): values for channel, values in result.items()}


def _listed(names: Sequence[str], between: str = ", ") -> str:
    shown = between.join(map(repr, names[:MAX_LISTED_COLUMNS]))
    if len(names) > MAX_LISTED_COLUMNS:
        shown += f" and {len(names) - MAX_LISTED_COLUMNS} more"
    return shown


def _quoted(channel: str, name: str) -> str:
    """Quote a column for the shell and for `ImportConfig`; an unprintable name becomes NAME."""
    pair = f"{channel}={name if name.isprintable() else 'NAME'}"
    return shlex.quote(f'"{pair}"' if "," in pair else pair)
