"""What the name of a column says: which channel of a log it holds, and in which unit.

One table of synonyms and one of units, for every kind of file whose columns have names. Case and separators do not
count: ``cmd angle [deg]``, ``CmdAngle_deg`` and ``COMMAND-ANGLE (deg)`` are the same.
"""

import math
import re
from typing import NamedTuple

KINDS = {
    "time": "time",
    "command_angle": "angle",
    "command_velocity": "velocity",
    "angle": "angle",
    "velocity": "velocity",
    "force_x": "force",
    "force_y": "force",
}
"""Channel: the physical quantity that it is."""

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "turn": 2 * math.pi},
    "velocity": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180, "turn/s": 2 * math.pi, "rpm": 2 * math.pi / 60,
    },
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216152605},
}  # fmt: skip
"""Quantity: its units, the SI unit first, each with the factor that makes it the SI unit."""

SI = {kind: next(iter(units)) for kind, units in UNITS.items()}

SPELLINGS = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millis millisec millisecond milliseconds",
    "us": "us usec usecs micros microsec microsecond microseconds",
    "ns": "ns nsec nsecs nanos nanosec nanosecond nanoseconds",
    "min": "min mins minute minutes",
    "rad": "rad rads radian radians",
    "mrad": "mrad mrads milliradian milliradians",
    "deg": "deg degs degree degrees °",
    "turn": "turn turns rev revs revolution revolutions",
    "rpm": "rpm rev/min revs/min revolutions/minute",
    "N": "n newton newtons",
    "mN": "mn millinewton millinewtons",
    "kN": "kn kilonewton kilonewtons",
    "gf": "gf",
    "kgf": "kgf",
    "lbf": "lbf",
}
"""Unit: how it is written, in lower case; velocities are an angle's spelling, a slash and a second's."""

COMMAND_WORDS = {
    "command", "commanded", "cmd", "target", "desired", "des", "demand", "demanded", "setpoint", "set", "goal",
    "reference", "ref",
}  # fmt: skip
"""They make an angle or a velocity the commanded one. Standing alone, they are the commanded angle; not so
"reference", which may be a force."""

PHRASES = {
    "time": ["time", "t", "timestamp", "stamp", "time stamp"],
    "angle": ["angle", "ang", "theta", "θ", "position", "pos", "angular position"],
    "velocity": [
        "velocity", "vel", "speed", "omega", "ω", "angular velocity", "ang vel", "angular vel", "angular speed",
        "angle rate", "angular rate", "theta dot", "angle velocity", "angle vel",
    ],
    "command_velocity": ["profile velocity", "profile vel", "profile speed"],
    "force_x": ["force x", "fx", "f x"],
    "force_y": ["force y", "fy", "f y"],
}  # fmt: skip
"""Channel: what it is called, in any order of the words; with one of `COMMAND_WORDS`, it is the commanded one."""

NEUTRAL_WORDS = {
    "actual", "act", "measured", "meas", "reading", "value", "joint", "shaft", "motor", "servo", "drive", "fin",
    "encoder", "sensor", "wrench", "ft", "state", "states", "feedback", "header", "elapsed", "unix", "epoch", "ros",
    "in",
}  # fmt: skip
"""They may stand in a name without changing what it means."""

_PHRASES = {tuple(sorted(phrase.split())): channel for channel, some in PHRASES.items() for phrase in some}

_WORDS = COMMAND_WORDS | NEUTRAL_WORDS | {word for phrase in _PHRASES for word in phrase}

_JOINED = sorted((word for word in _WORDS - NEUTRAL_WORDS if len(word) > 2 or word in "xyθω"), key=len, reverse=True)
"""Words that are recognised without a separator between them, as in ``targetangle``."""

_BRACKETS = re.compile(r"[\[({<]([^\])}>]*)[\])}>]")


def _spelled(kind: str) -> dict[str, str]:
    known = {text: unit for unit, texts in SPELLINGS.items() if unit in UNITS[kind] for text in texts.split()}
    if kind == "velocity":
        seconds = SPELLINGS["s"].split()
        for unit in UNITS["angle"]:
            known |= {f"{text}/{second}": f"{unit}/s" for text in SPELLINGS[unit].split() for second in seconds}
        known |= {"dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "rps": "turn/s"}
    return known


SPELLED = {kind: _spelled(kind) for kind in UNITS}
"""Quantity: {how a unit is written, in lower case: the unit}."""


class ColumnName(NamedTuple):
    """What a name was read as."""

    channel: str
    unit: str | None
    """None where the name says none."""
    unclear: str
    """The part of the name that is neither a known word nor a known unit; empty where all of it was understood."""


def read_name(name: str) -> ColumnName | None:
    """The channel that a name means; None where it means none. With an unclear part it is no more than a guess."""
    guesses = []
    for kind in UNITS:
        words, unit, unknown = _split(name, kind)
        channel = _channel(words, kind, unit)
        if channel is not None and not unknown:
            return ColumnName(channel, unit, "")
        known = [word for word in words if word in _WORDS]
        channel = _channel(known, kind, unit) if set(known) - COMMAND_WORDS - NEUTRAL_WORDS else None
        if channel is not None:
            guesses.append(ColumnName(channel, unit, unknown or " ".join(word for word in words if word not in _WORDS)))
    return guesses[0] if guesses else None


def unit_in(name: str, kind: str) -> tuple[str | None, str]:
    """The unit of this quantity that a name states, or None; and what stands in its brackets and is no such unit."""
    _, unit, unknown = _split(name, kind)
    return unit, unknown


def _channel(words: list[str], kind: str, unit: str | None) -> str | None:
    """The channel of this quantity that the words mean; every one of them counts."""
    core = tuple(sorted(word for word in words if word not in COMMAND_WORDS | NEUTRAL_WORDS))
    commanded = COMMAND_WORDS.intersection(words)
    channel = _PHRASES.get(core)
    if not core and commanded - {"ref", "reference"} and (kind == "angle" or (kind == "velocity" and unit is not None)):
        channel = kind
    # Milliseconds are a time without any other word, but "s", "n" and "min" are more often something else.
    if not words and kind == "time" and unit in ("s", "ms", "us", "ns"):
        channel = "time"
    if channel in ("angle", "velocity") and commanded:
        channel = f"command_{channel}"
    elif commanded and channel != "command_velocity":
        return None
    return channel if channel is not None and KINDS[channel] == kind else None


def _split(name: str, kind: str) -> tuple[list[str], str | None, str]:
    """The words of a name without its unit; the unit, if it is one of this quantity; what in brackets is neither."""
    unit, unknown, inside = None, "", []
    for text in _BRACKETS.findall(name):
        words = _tokens(text)
        if unit is None and _spelling(text) in SPELLED[kind]:
            unit = SPELLED[kind][_spelling(text)]
        elif words and all(word in _WORDS for word in words):
            # "(t)" as in "angle(t)" says that it is a function of time.
            inside += [word for word in words if word != "t"]
        else:
            unknown = text.strip() or text
    outside = _tokens(_BRACKETS.sub(" ", name))
    if unit is None and not unknown:
        for start in range(max(len(outside) - 3, 0), len(outside)):
            ending = [token for token in outside[start:] if token != "per"]
            if "/".join(ending) in SPELLED[kind] and (start > 0 or inside or len(ending[0]) > 1):
                return _apart(outside[:start] + inside), SPELLED[kind]["/".join(ending)], ""
    return _apart(outside + inside), unit, unknown


def _spelling(text: str) -> str:
    """A unit in brackets as `SPELLED` has it: ``Rad s^-1``, ``rad per sec`` become ``rad/s``, ``rad/sec``."""
    plain = re.sub(r"(?<=[\s.·*_])s(\^|\*\*)?(-1|⁻¹)$", "s", _lower(text).strip())
    parts = [part for part in re.split(r"[\s/_.·*-]+", plain) if part != "per"]
    return "/".join(parts)


def _tokens(text: str) -> list[str]:
    """Words in lower case: parted by anything but letters, and where capitals begin, but not within mN."""
    parted = re.sub(r"(?<=[^\W\d_A-Z]{2})(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    return re.findall(r"[^\W\d_]+|\d+|°", _lower(parted))


def _lower(text: str) -> str:
    return text.lower().replace("µ", "u").replace("μ", "u")


def _apart(words: list[str]) -> list[str]:
    """The words, with those taken apart that are made of known ones; "set point" is one."""
    apart = [part for word in words for part in ([word] if word in _WORDS else _parts(word) or [word])]
    return " ".join(apart).replace("set point", "setpoint").split()


def _parts(word: str) -> list[str]:
    """Known words that make up this one, or none."""
    if word in _JOINED:
        return [word]
    for first in _JOINED:
        if word.startswith(first):
            rest = _parts(word[len(first) :])
            if rest:
                return [first, *rest]
    return []
