"""Assignment of columns to channels, and conversion from the recording's units and axes to
softfin's.

What the user states counts first, then softfin's own names, then what `read_name` finds in a name;
if two columns could be the same channel, both are refused. Every column without softfin's own name
is shown with its unit.
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
"""Channel of each of softfin's own columns."""

MAX_LISTED_COLUMNS = 12
"""Largest number of names that a message lists."""


class Column(NamedTuple):
    """The column from which a channel is read."""

    name: str
    unit: str
    """Unit of its values."""
    is_unit_stated: bool
    """Whether its name or an option states the unit; otherwise the SI unit is assumed."""


def choose_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, Column]:
    """Find the column of each channel; raises LogError, naming the option that decides, if it is
    not certain."""
    found = {
        channel: name
        for name, channel in OWN_NAMES.items()
        if name in names and channel not in config.columns
    }
    found |= _mapped_columns(names, config, source)
    # Nothing is guessed that an option states for the whole file.
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
    """Return the columns that --columns names."""
    mapped: dict[str, str] = {}
    for channel, name in config.columns.items():
        if name not in (NO_COLUMN, *names):
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LogError(
                f"{source}: --columns {channel}={name}: no such column; {hint}it has "
                f"{_listed(names)}"
            )
        if name != NO_COLUMN:
            mapped[channel] = name
    return mapped


def _recognized_columns(
    names: Sequence[str], taken: Collection[str], decided: Collection[str], source: str
) -> dict[str, str]:
    """Return the columns that are recognized by their names, for channels that are not yet
    decided."""
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
                f"{source}: which column is {channel}? It may be {_listed(several, ' or ')}; "
                f"decide it: --columns {_quoted(channel, several[0])}"
            )
        recognized[channel] = several[0]
    return recognized


def _missing_error(names: Sequence[str], missing: Sequence[str], source: str) -> LogError:
    others = {
        "time": "; --rate 100 takes the place of time, if a row was written every 10 ms",
        "command_velocity": (
            "; --velocity 3.1 takes its place, if all commands had that velocity [rad/s]"
        ),
    }
    mapping = ",".join(f"{channel}=NAME" for channel in missing)
    hints = "".join(others.get(channel, "") for channel in missing)
    return LogError(
        f"{source}: which column is {missing[0]}? Of {_listed(names)} none has a name of known "
        f"words and units ({', '.join(UNITS[KINDS[missing[0]]])}) that means it; name it: "
        f"--columns {mapping}{hints}"
    )


def _preferred_velocities(names: list[str]) -> list[str]:
    """Prefer profile velocities: a goal velocity next to one belongs to the drive's velocity
    mode."""
    profiles = [name for name in names if "profile" in split_unit(name, "velocity")[0]]
    return profiles or names


def stated_unit(channel: str, config: ImportConfig) -> str | None:
    """Unit of a channel that the options state, or None."""
    if channel == "time":
        return config.time_unit
    if channel.startswith("force"):
        return config.force_unit
    unit = next((unit for angle, unit in config.angles.items() if angle == channel), None)
    return unit if unit is None or unit in UNITS[KINDS[channel]] else f"{unit}/s"


def describe_columns(columns: Mapping[str, Column]) -> str:
    """Describe which columns were used, as far as their names are not softfin's own; empty if all
    are."""
    return ", ".join(
        f"{channel}={column.name!r} in {column.unit}"
        + ("" if column.is_unit_stated else " (assumed)")
        for channel, column in columns.items()
        if OWN_NAMES.get(column.name) != channel
    )


def converted(
    channels: Mapping[str, Float[np.ndarray, "rows"]],
    config: ImportConfig,
    units: Mapping[str, str] | None = None,
) -> dict[str, Float[np.ndarray, "rows"]]:
    """Convert to SI units and softfin's signs and axes; `units` are those stated by the channels;
    otherwise those of the options, or SI."""
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or stated_unit(channel, config) or SI[kind]
        result[channel] = values if unit == SI[kind] else values * UNITS[kind][unit]
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
    return shown + (
        f" and {len(names) - MAX_LISTED_COLUMNS} more" if len(names) > MAX_LISTED_COLUMNS else ""
    )


def _quoted(channel: str, name: str) -> str:
    """Write a column so that a shell and `ImportConfig` can read it; NAME for what cannot be
    typed."""
    pair = f"{channel}={name if name.isprintable() else 'NAME'}"
    return shlex.quote(f'"{pair}"' if "," in pair else pair)
