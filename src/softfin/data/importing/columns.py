"""Which column is which channel, and from the recording's units and axes to softfin's.

What the user states counts first, then softfin's own names, then what `read_name` finds in a name; two columns that
may be the same channel are refused. Every column that is not named as softfin does is shown with its unit.
"""

import difflib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.data.importing.importing import CHANNELS, NO_COLUMN, ImportConfig
from softfin.data.importing.names import KINDS, SI, UNITS, read_name, unit_in
from softfin.storage.log_file import SCHEMA

OWN_NAMES = dict(zip(SCHEMA.names, CHANNELS, strict=True))
"""Channel of each of softfin's own columns."""

REQUIRED = ("command_angle", "command_velocity", "angle", "force_x", "force_y")

LISTED = 12
"""Most names that a message lists."""


class Column(NamedTuple):
    """The column that a channel is read from."""

    name: str
    unit: str
    """Unit of its values."""
    is_unit_stated: bool
    """Whether its name or an option states the unit; else it is the SI unit, assumed."""
    is_guessed: bool
    """Whether its name alone made it this channel."""


def choose_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, Column]:
    """Find the column of each channel; raises LogError, naming the option that decides, where it is not certain."""
    found = {channel: name for name, channel in OWN_NAMES.items() if name in names and channel not in config.columns}
    for channel, name in config.columns.items():
        if name == NO_COLUMN:
            continue
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LogError(f"{source}: --columns {channel}={name}: no such column; {hint}it has {_listed(names)}")
        found[channel] = name
    # What an option states for the whole file is not guessed.
    options = {"time": config.rate_hz, "command_velocity": config.velocity_rad_s}
    stated = [channel for channel, value in options.items() if value is not None]
    settled = {*found, *config.columns, *stated}
    candidates: dict[str, list[str]] = {}
    for name in names:
        read = read_name(name)
        if read is not None and name not in found.values() and read.channel not in settled:
            candidates.setdefault(read.channel, []).append(name)
    for channel, several in candidates.items():
        if len(several) > 1:
            raise LogError(
                f"{source}: which column is {channel}? It may be {_listed(several, ' or ')}; "
                f"decide it: --columns {_quoted({channel: several[0]})}"
            )
        found[channel] = several[0]
    _check_complete(names, {*found, *stated}, source)
    columns = {}
    for channel in CHANNELS:
        if channel in found:
            unit = stated_unit(channel, config) or unit_in(found[channel], KINDS[channel])
            is_stated, is_guessed = unit is not None, channel in candidates
            columns[channel] = Column(found[channel], unit or SI[KINDS[channel]], is_stated, is_guessed)
    return columns


def _check_complete(names: Sequence[str], found: set[str], source: str) -> None:
    missing = [channel for channel in REQUIRED if channel not in found]
    if missing:
        way_out = f"name it: --columns {_quoted(dict.fromkeys(missing, 'NAME'))}"
        if "command_velocity" in missing:
            way_out += "; --velocity 3.1 takes its place, if all commands had that velocity [rad/s]"
        units = ", ".join(UNITS[KINDS[missing[0]]])
        raise LogError(
            f"{source}: which column is {missing[0]}? Of {_listed(names)} none has a name of known words and units "
            f"({units}) that means it; {way_out}"
        )
    if "time" not in found:
        raise LogError(
            f"{source}: no column of time in a known unit ({', '.join(UNITS['time'])}); give --rate 100 if a row was "
            f"written every 10 ms, or name it: --columns time=NAME (it has {_listed(names)})"
        )


def stated_unit(channel: str, config: ImportConfig) -> str | None:
    """Unit of a channel that the options state, or None."""
    if channel == "time":
        return config.time_unit
    if channel.startswith("force"):
        return config.force_unit
    unit = config.angles.get(channel)
    return unit if unit is None or unit in UNITS[KINDS[channel]] else f"{unit}/s"


def describe_columns(columns: Mapping[str, Column]) -> str:
    """What was read from where, of the columns with names of their own; empty where there are none."""
    parts = []
    for is_guessed, why in ((True, "by the names: "), (False, "by --columns: ")):
        some = [
            f"{channel}={column.name!r} in {column.unit}" + ("" if column.is_unit_stated else " (assumed)")
            for channel, column in columns.items()
            if column.is_guessed is is_guessed and OWN_NAMES.get(column.name) != channel
        ]
        parts += [why + ", ".join(some)] if some else []
    return "; ".join(parts)


def converted(
    channels: Mapping[str, Float[np.ndarray, "rows"]], config: ImportConfig, units: Mapping[str, str] | None = None
) -> dict[str, Float[np.ndarray, "rows"]]:
    """Convert to SI units and softfin's signs and axes; `units` are the channels' own, else the options' or SI."""
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or stated_unit(channel, config) or SI[kind]
        result[channel] = values if unit == SI[kind] else values * UNITS[kind][unit]
    # The commanded velocity is a magnitude without a sign to turn.
    turned = {*config.negate, *(["velocity"] if "angle" in config.negate else [])} - {"command_velocity"}
    for channel in turned & result.keys():
        result[channel] = -result[channel]
    if "force_x" in result:
        frame: str = config.force
        source = {"x": result["force_x"], "y": result["force_y"]}
        for channel, term in zip(("force_x", "force_y"), frame.split(","), strict=True):
            result[channel] = -source[term[1:]] if term.startswith("-") else source[term]
    return result


def _listed(names: Sequence[str], between: str = ", ") -> str:
    shown = between.join(map(repr, names[:LISTED]))
    return shown + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")


def _quoted(columns: Mapping[str, str]) -> str:
    """Write columns as a shell and `ImportConfig` read them; NAME for what cannot be typed."""
    pairs: Iterable[str] = (f"{channel}={name if name.isprintable() else 'NAME'}" for channel, name in columns.items())
    return shlex.quote(",".join(f'"{pair}"' if "," in pair else pair for pair in pairs))
