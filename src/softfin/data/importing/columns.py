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
from softfin.data.importing.importing import NO_COLUMN, ImportConfig, turned
from softfin.data.importing.names import CHANNELS, KINDS, SI, UNITS, read_name, split_unit
from softfin.storage.log_file import SCHEMA

OWN_NAMES = dict(zip(SCHEMA.names, CHANNELS, strict=True))
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
    not unique."""
    own = [name for name in OWN_NAMES if name in names and OWN_NAMES[name] not in config.columns]
    found = {OWN_NAMES[name]: name for name in own}
    found |= _mapped_columns(names, config, source)
    # Channels with a fixed value for the entire file are not looked up by name.
    options = {"time": config.rate_hz, "command_velocity": config.velocity_rad_s}
    stated = [channel for channel, value in options.items() if value is not None]
    decided = {*found, *config.columns, *stated}
    found |= _recognized_columns(names, found.values(), decided, source)
    settled = {*found, *stated, "velocity"}
    if missing := [channel for channel in CHANNELS if channel not in settled]:
        raise _missing_error(names, missing, source)
    columns = {}
    for channel in CHANNELS:
        if channel in found:
            unit = stated_unit(channel, config) or split_unit(found[channel], KINDS[channel])[1]
            columns[channel] = Column(found[channel], unit or SI[KINDS[channel]], unit is not None)
    return columns


def _mapped_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, str]:
    """Return the columns that the option --columns assigns."""
    mapped: dict[str, str] = {}
    for channel, name in config.columns.items():
        if name not in (NO_COLUMN, *names):
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LogError(
                f"{source}: --columns {channel}={name}: no such column; {hint}the file has "
                f"{_listed(names)}"
            )
        if name != NO_COLUMN:
            mapped[channel] = name
    return mapped


def _recognized_columns(
    names: Sequence[str], taken: Collection[str], decided: Collection[str], source: str
) -> dict[str, str]:
    """Return the columns recognized by name, for channels that are not yet decided."""
    candidates: dict[str, list[str]] = {}
    for name in names:
        read = read_name(name)
        if read is not None and name not in taken and read[0] not in decided:
            candidates.setdefault(read[0], []).append(name)
    recognized = {}
    for channel, several in candidates.items():
        if channel == "command_velocity":
            several = _preferred_velocities(several)
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
    """Convert to SI units and to softfin's signs and axes.

    Units come from `units`, otherwise from the options; the default is SI.
    """
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or stated_unit(channel, config) or SI[kind]
        result[channel] = values if unit == SI[kind] else values * UNITS[kind][unit]
    # A reversed angle reverses its velocity.
    negated = {*config.negate, *(["velocity"] if "angle" in config.negate else [])}
    for channel in negated & result.keys():
        result[channel] = -result[channel]
    if "force_x" in result:
        result["force_x"], result["force_y"] = turned(
            result["force_x"], result["force_y"], config.force
        )
    return result


def _listed(names: Sequence[str], between: str = ", ") -> str:
    shown = between.join(map(repr, names[:MAX_LISTED_COLUMNS]))
    if len(names) > MAX_LISTED_COLUMNS:
        shown += f" and {len(names) - MAX_LISTED_COLUMNS} more"
    return shown


def _quoted(channel: str, name: str) -> str:
    """Quote a column for the shell and for `ImportConfig`; an unprintable name becomes NAME."""
    pair = f"{channel}={name if name.isprintable() else 'NAME'}"
    return shlex.quote(f'"{pair}"' if "," in pair else pair)
