"""Which column is which channel, and from the recording's units and axes to softfin's. Never guessed: suggested."""

import difflib
import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from softfin.errors import LogError
from softfin.logs.importing import CHANNELS, ImportConfig
from softfin.logs.parquet import SCHEMA

OWN_NAMES = dict(zip(SCHEMA.names, CHANNELS, strict=True))
"""Softfin's column: channel. These need no mapping."""

REQUIRED = ("command_angle", "command_velocity", "angle", "force_x", "force_y")


def channels_of(names: Sequence[str], config: ImportConfig, source: str) -> dict[str, str]:
    """Channel: its column; raises LogError, with an option to copy, where a channel that is needed has none."""
    own = {channel: name for name, channel in OWN_NAMES.items() if name in names}
    for channel, name in config.columns.items():
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LogError(
                f"{source}: --columns {channel}={name}: there is no such column; {hint}it has {_list(names)}"
            )
    found = own | config.columns
    missing = [channel for channel in REQUIRED if channel not in found]
    if missing:
        raise LogError(
            f"{source}: which column is {missing[0]}? It has {_list(names)}; say it: {suggestion(names, found)}"
        )
    if "time" not in found and config.rate_hz is None:
        raise LogError(
            f"{source}: no column of time; give --rate 100 if a row was written every 10 ms, "
            f"or name it: --columns time=NAME (it has {_list(names)})"
        )
    return found


def suggestion(names: Sequence[str], found: Mapping[str, str] | None = None) -> str:
    """An option ``--columns ...`` with what the names look like, and NAME where none does."""
    found = found or {}
    taken = set(found.values())
    guesses: dict[str, str] = {}
    for name in names:
        channel = looks_like(name)
        if channel is not None and name not in taken:
            guesses.setdefault(channel, name)
    asked = [channel for channel in CHANNELS if channel not in found and (channel in REQUIRED or channel in guesses)]
    return "--columns " + _quoted(",".join(f"{channel}={guesses.get(channel, 'NAME')}" for channel in asked))


def looks_like(name: str) -> str | None:
    """The channel that a name obviously means, or None."""
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    text = "".join(words)
    command = any(word in text for word in ("command", "cmd", "target", "desired", "setpoint", "goal", "demand"))
    if any(word in text for word in ("velocity", "vel", "speed", "omega")):
        return "command_velocity" if command else "velocity"
    if any(word in text for word in ("angle", "position", "theta")) or "pos" in words:
        return "command_angle" if command else "angle"
    for axis in ("x", "y"):
        if ("force" in text and axis in words) or text in (f"f{axis}", f"force{axis}", f"fn{axis}", f"f{axis}n"):
            return f"force_{axis}"
    return "time" if words[:1] in (["time"], ["timestamp"], ["stamp"], ["t"]) else None


def converted(
    channels: Mapping[str, Float[np.ndarray, "rows"]], config: ImportConfig
) -> dict[str, Float[np.ndarray, "rows"]]:
    """In radians, with softfin's signs and axes of force."""
    result = dict(channels)
    for channel, unit in config.angles.items():
        if unit == "deg" and channel in result:
            result[channel] = np.radians(result[channel])
    # The commanded velocity is a magnitude: no sign to turn.
    turned = {*config.negate, *(["velocity"] if "angle" in config.negate else [])} - {"command_velocity"}
    for channel in turned & result.keys():
        result[channel] = -result[channel]
    if "force_x" in result:
        frame: str = config.force
        source = {"x": channels["force_x"], "y": channels["force_y"]}
        for channel, term in zip(("force_x", "force_y"), frame.split(","), strict=True):
            result[channel] = -source[term[1:]] if term.startswith("-") else source[term]
    return result


def _list(names: Sequence[str]) -> str:
    shown = [repr(name) for name in names[:12]]
    return ", ".join(shown) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def _quoted(text: str) -> str:
    return f"'{text}'" if re.search(r"[^\w=,./-]", text) else text
