"""Which column is which channel, and from the recording's units and axes to softfin's.

What the user says counts first, then softfin's own names, then what `names` reads in a name; two columns that may be
the same channel are refused. Every column that is not named as softfin does is shown, with its unit (`shown`).
"""

import difflib
import shlex
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.errors import LogError
from softfin.data.importing.importing import CHANNELS, NO_COLUMN, ImportConfig
from softfin.data.importing.names import KINDS, SI, UNITS, read_name, unit_in
from softfin.storage.log_file import SCHEMA

OWN_NAMES = dict(zip(SCHEMA.names, CHANNELS, strict=True))
"""Softfin's column: channel. These need no mapping."""

REQUIRED = ("command_angle", "command_velocity", "angle", "force_x", "force_y")

LISTED = 12
"""Names in a message, at most."""


class Column(NamedTuple):
    """The column that a channel is read from."""

    name: str
    unit: str
    """That its values are in."""
    stated: bool
    """Whether the name or an option says so; else it is the SI unit, assumed."""
    guessed: bool
    """Whether its name alone made it this channel."""
    unclear: str = ""
    """What stands in the brackets of its name and is no unit of this channel; its values are taken as SI."""


def choose_columns(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, Column]:
    """Channel: its column; raises LogError, naming the option that decides, where one is missing or two may be it."""
    mapped = {channel: name for channel, name in config.columns.items() if name != NO_COLUMN}
    for channel, name in mapped.items():
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LogError(
                f"{source}: --columns {channel}={name}: there is no such column; {hint}it has {_list(names)}"
            )
    own = {channel: name for name, channel in OWN_NAMES.items() if name in names and channel not in config.columns}
    found = own | mapped
    # What an option states for the whole file is not guessed.
    stated = {"time": config.rate_hz is not None, "command_velocity": config.velocity_rad_s is not None}
    settled = {*found, *config.columns, *(channel for channel, told in stated.items() if told)}
    guessed = _guessed([name for name in names if name not in found.values()], settled, source)
    found |= guessed
    _check_complete(names, found, stated, source)
    return {
        channel: _column(channel, found[channel], channel in guessed, config)
        for channel in CHANNELS
        if channel in found
    }


def _guessed(names: Sequence[str], settled: set[str], source: str) -> dict[str, str]:
    """The channels that are not settled, by the names that are understood whole."""
    candidates: dict[str, list[str]] = {}
    for name in names:
        read = read_name(name)
        if read is not None and not read.unclear and read.channel not in settled:
            candidates.setdefault(read.channel, []).append(name)
    for channel, several in candidates.items():
        if len(several) > 1:
            raise LogError(
                f"{source}: which column is {channel}? It may be {_list(several, ' or ')}; "
                f"decide it: --columns {_quoted({channel: several[0]})}"
            )
    return {channel: name for channel, (name,) in candidates.items()}


def _check_complete(names: Sequence[str], found: Mapping[str, str], stated: Mapping[str, bool], source: str) -> None:
    missing = [channel for channel in REQUIRED if channel not in found and not stated.get(channel)]
    if missing:
        way_out = f"say it: {suggestion(names, {**found, **{channel: '' for channel, told in stated.items() if told}})}"
        if "command_velocity" in missing:
            way_out += "; --velocity 3.1 takes its place, if all commands had that velocity [rad/s]"
        doubt = _doubt(names, missing[0])
        raise LogError(f"{source}: which column is {missing[0]}? {doubt}It has {_list(names)}; {way_out}")
    if "time" not in found and not stated["time"]:
        raise LogError(
            f"{source}: no column of time; {_doubt(names, 'time')}give --rate 100 if a row was written every 10 ms, "
            f"or name it: --columns time=NAME (it has {_list(names)})"
        )


def _doubt(names: Sequence[str], channel: str) -> str:
    """Why the columns that look like it were not taken."""
    for name in names:
        read = read_name(name)
        if read is not None and read.channel == channel:
            known = ", ".join(UNITS[KINDS[channel]])
            why = f"{read.unclear!r} is no known word or unit (units: {known}; others must be converted first)"
            return f"{name!r} may be, but {why}. "
    return ""


def _column(channel: str, name: str, guessed: bool, config: ImportConfig) -> Column:
    kind = KINDS[channel]
    stated, unclear = unit_in(name, kind)
    told = told_unit(channel, config)
    unit = told or stated
    return Column(name, unit or SI[kind], unit is not None, guessed, "" if told else unclear)


def told_unit(channel: str, config: ImportConfig) -> str | None:
    """The unit of a channel that the options state, or None."""
    if channel == "time":
        return config.time_unit
    if channel.startswith("force"):
        return config.force_unit
    unit = config.angles.get(channel)
    return unit if unit is None or unit in UNITS[KINDS[channel]] else f"{unit}/s"


def shown(columns: Mapping[str, Column]) -> str:
    """What was read from where, of the columns that are not named as softfin names them; empty where there are none."""
    foreign = {channel: column for channel, column in columns.items() if OWN_NAMES.get(column.name) != channel}
    parts = []
    for guessed, why in ((True, "by the names: "), (False, "by --columns: ")):
        some = [
            f"{channel}={column.name!r} in {column.unit}" + ("" if column.stated else " (assumed)")
            for channel, column in foreign.items()
            if column.guessed is guessed
        ]
        parts += [why + ", ".join(some)] if some else []
    return "; ".join(parts)


def suggestion(names: Sequence[str], found: Mapping[str, str] | None = None) -> str:
    """An option ``--columns ...`` with what the names look like, and NAME where none does."""
    found = found or {}
    taken = set(found.values())
    guesses: dict[str, str] = {}
    for name in names:
        read = read_name(name)
        if read is not None and name not in taken:
            guesses.setdefault(read.channel, name)
    asked = [channel for channel in CHANNELS if channel not in found and (channel in REQUIRED or channel in guesses)]
    return "--columns " + _quoted({channel: guesses.get(channel, "NAME") for channel in asked})


def converted(
    channels: Mapping[str, Float[np.ndarray, "rows"]], config: ImportConfig, units: Mapping[str, str] | None = None
) -> dict[str, Float[np.ndarray, "rows"]]:
    """In SI units, with softfin's signs and axes of force; `units` are the channels' own, else the options' or SI."""
    result = {}
    for channel, values in channels.items():
        kind = KINDS[channel]
        unit = (units or {}).get(channel) or told_unit(channel, config) or SI[kind]
        result[channel] = values if unit == SI[kind] else values * UNITS[kind][unit]
    # The commanded velocity is a magnitude: no sign to turn.
    turned = {*config.negate, *(["velocity"] if "angle" in config.negate else [])} - {"command_velocity"}
    for channel in turned & result.keys():
        result[channel] = -result[channel]
    if "force_x" in result:
        frame: str = config.force
        source = {"x": result["force_x"], "y": result["force_y"]}
        for channel, term in zip(("force_x", "force_y"), frame.split(","), strict=True):
            result[channel] = -source[term[1:]] if term.startswith("-") else source[term]
    return result


def _list(names: Sequence[str], between: str = ", ") -> str:
    shown = [repr(name) for name in names[:LISTED]]
    return between.join(shown) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")


def _quoted(columns: Mapping[str, str]) -> str:
    """As a shell and `ImportConfig` read it; NAME for what cannot be typed."""
    pairs = [f"{channel}={name if name.isprintable() else 'NAME'}" for channel, name in columns.items()]
    text = ",".join(f'"{pair}"' if "," in pair else pair for pair in pairs)
    return shlex.quote(text)
