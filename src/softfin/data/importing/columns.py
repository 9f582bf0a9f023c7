"""Assign columns to channels, and convert from the recording's units and axes to softfin's.

The user's options take precedence, then softfin's own column names, then names that `read_name`
recognizes. If two columns could be the same channel, neither is used and an error asks the user to
choose. Every column whose name is not softfin's own is reported with its unit.
"""

import difflib
import shlex
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.core.log_channels import LOG_COLUMNS
from softfin.data.importing.importing import NO_COLUMN, ImportConfig, turned
from softfin.data.importing.names import (
    CHANNELS,
    FURTHER,
    KINDS,
    SI,
    UNITS,
    read_name,
    split_unit,
)

OWN_NAMES = dict(zip(LOG_COLUMNS, CHANNELS, strict=True)) | {
    name: channel for channel, name in FURTHER.items()
}
"""Channels by softfin's own column names."""

MAX_LISTED_COLUMNS = 12
"""Maximum number of column names in a message."""


class Column(NamedTuple):
    """The column from which a channel is read."""

    name: str
    unit: str
    """Unit of the values."""
    is_unit_stated: bool
    """Whether the name or an option states the unit; otherwise the SI unit is assumed."""


def choose_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, Column]:
    """Find the column of each channel; raises LogError, with the option to use, if the choice is
    not unique for a channel of every log."""
    own = [name for name in OWN_NAMES if name in names and OWN_NAMES[name] not in config.columns]
    found = {OWN_NAMES[name]: name for name in own}
    found |= _mapped_columns(names, config, source)
    # Channels with a fixed value for the entire file are not looked up by name.
    options = {"time": config.rate_hz, "command_velocity": config.velocity_rad_s}
    stated = [channel for channel, value in options.items() if value is not None]
    decided = {*found, *config.columns, *stated}
    found |= _recognized_columns(names, list(found.values()), decided, source)
    settled = {*found, *stated, "velocity"}
    if missing := [channel for channel in CHANNELS if channel not in settled]:
        raise _missing_error(names, missing, source)
    columns = {}
    for channel in (*CHANNELS, *FURTHER):
        if channel in found:
            unit = stated_unit(channel, config) or split_unit(found[channel], KINDS[channel])[1]
            columns[channel] = Column(found[channel], unit or SI[KINDS[channel]], unit is not None)
    return columns


def _mapped_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, str]:
    """Return the columns that the option --columns assigns."""
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
    for name in names:
        read = read_name(name)
        if read is None or name in taken or read[0] in decided:
            continue
        channel, unit = read
        # A torque or current without a unit may be a register of the drive, in counts.
        if channel in CHANNELS or unit is not None:
            candidates.setdefault(channel, []).append(name)
    recognized = {}
    for channel, several in candidates.items():
        if channel == "command_velocity":
            several = _preferred_velocities(several)
        if len(several) > 1 and channel in FURTHER:
            continue
        if len(several) > 1:
            raise LogError(
                f"{source}: {channel} could be {_listed(several, ' or ')}; choose one with "
                f"--columns {_quoted(channel, several[0])}"
            )
        recognized[channel] = several[0]
    return recognized


def _missing_error(names: Sequence[str], missing: Sequence[str], source: str) -> LogError:
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
    return LogError(
        f"{source}: no column recognized as {missing[0]} among {_listed(names)} (known units: "
        f"{', '.join(UNITS[KINDS[missing[0]]])}); map it with --columns {mapping}{hints}"
    )


def _preferred_velocities(names: list[str]) -> list[str]:
    """Prefer profile velocities; a goal velocity next to a profile velocity is for the drive's
    velocity mode."""
    profiles = [name for name in names if "profile" in split_unit(name, "velocity")[0]]
    return profiles or names


def stated_unit(channel: str, config: ImportConfig) -> str | None:
    """Return the unit that the options set for a channel, or None."""
    if channel == "time":
        return config.time_unit
    if channel.startswith("force"):
        return config.force_unit
    # Not config.angles.get(channel): the keys are literals, and `channel` may be any channel.
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
    """Convert to SI units and to softfin's signs and axes; further channels get their names in a
    log.

    Units come from `units`, otherwise from the options; the default is SI.
    """
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or stated_unit(channel, config) or SI[kind]
        if kind == "angle":
            values = values - config.angle_zero
        result[channel] = values if unit == SI[kind] else values * UNITS[kind][unit]
    # A reversed angle reverses its velocity.
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
        # The torque about one axis alone cannot be turned.
        result = {name: result[name] for name in result if name not in ("torque_x", "torque_y")}
    # A sensor with x and y mirrored faces the other way, so its z axis is reversed.
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
