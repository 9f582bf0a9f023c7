"""Reads the channel and the unit from the name of a column.

One table of words and one of units, for every kind of file whose columns have names. Case and
separators do not count: ``cmd angle [deg]``, ``CmdAngle_deg`` and ``COMMAND-ANGLE (deg)`` are the
same.
"""

import itertools
import math
import re
from typing import Literal, get_args

Channel = Literal[
    "time", "command_angle", "command_velocity", "angle", "velocity", "force_x", "force_y"
]

CHANNELS: tuple[str, ...] = get_args(Channel)
"""Channels of a log. A recording may lack the velocity, and also time and commanded velocity if an
option gives them."""

KINDS: dict[str, str] = {channel: re.sub("command_|_x|_y", "", channel) for channel in CHANNELS}
"""Physical quantity of each channel."""

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "turn": 2 * math.pi},
    "velocity": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.pi / 180,
        "turn/s": 2 * math.pi,
        "rpm": 2 * math.pi / 60,
    },
    "force": {
        "N": 1.0,
        "mN": 1e-3,
        "kN": 1e3,
        "gf": 9.80665e-3,
        "kgf": 9.80665,
        "lbf": 4.4482216152605,
    },
}
"""Units of each quantity, the SI unit first, with the factor that converts to it."""

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
"""Ways to write each unit, in lower case; those of a velocity are an angle's, a slash and those of
a second."""

COMMAND_WORDS = {
    "command",
    "commanded",
    "cmd",
    "target",
    "desired",
    "des",
    "demand",
    "demanded",
    "setpoint",
    "set",
    "goal",
    "reference",
    "ref",
}
"""Words that make an angle or a velocity the commanded one. Alone, all except "reference" mean the
commanded angle."""

PHRASES = {
    "time": ["time", "t", "timestamp", "stamp", "time stamp"],
    "angle": ["angle", "ang", "theta", "θ", "position", "pos", "angular position"],
    "velocity": [
        "velocity",
        "vel",
        "speed",
        "omega",
        "ω",
        "angular velocity",
        "ang vel",
        "angular vel",
        "angular speed",
        "angle rate",
        "angular rate",
        "theta dot",
        "angle velocity",
        "angle vel",
    ],
    # The last one is from Dynamixel's protocol 1.
    "command_velocity": ["profile velocity", "profile vel", "profile speed", "moving speed"],
    "force_x": ["force x", "fx", "f x"],
    "force_y": ["force y", "fy", "f y"],
}
"""Names of each channel, in any order of their words; with one of `COMMAND_WORDS`, the commanded
channel."""

NEUTRAL_WORDS = {
    "actual",
    "act",
    "present",
    "measured",
    "meas",
    "reading",
    "value",
    "joint",
    "shaft",
    "motor",
    "servo",
    "drive",
    "fin",
    "encoder",
    "sensor",
    "wrench",
    "ft",
    "state",
    "states",
    "feedback",
    "header",
    "elapsed",
    "unix",
    "epoch",
    "ros",
    "in",
    "point",
    "dynamixel",
    "dxl",
    "workbench",
}
"""Words that do not change the meaning of a name."""

_PHRASES = {
    tuple(sorted(phrase.split())): channel for channel, some in PHRASES.items() for phrase in some
}


def _spellings(kind: str) -> dict[str, str]:
    spelled: dict[str, str] = {}
    for unit in UNITS[kind]:
        spelled |= dict.fromkeys(SPELLINGS.get(unit, "").split(), unit)
    if kind == "velocity":
        for unit in UNITS["angle"]:
            for pair in itertools.product(SPELLINGS[unit].split(), SPELLINGS["s"].split()):
                spelled["/".join(pair)] = f"{unit}/s"
        spelled |= {"dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "rps": "turn/s"}
    return spelled


SPELLED = {kind: _spellings(kind) for kind in UNITS}
"""Unit of each way to write one, in lower case, by quantity."""


def read_name(name: str) -> tuple[str, str | None] | None:
    """Find the channel of a name, and its unit or None; both are None unless every word of it is
    understood."""
    for kind in UNITS:
        words, unit = split_unit(name, kind)
        commanded = COMMAND_WORDS.intersection(words)
        core = tuple(sorted(word for word in words if word not in COMMAND_WORDS | NEUTRAL_WORDS))
        channel = _PHRASES.get(core)
        if (
            not core
            and commanded - {"ref", "reference"}
            and (kind == "angle" or (kind == "velocity" and unit))
        ):
            channel = kind
        # Milliseconds mean a time without any other word, but "min" is more often something else.
        if not words and kind == "time" and unit in ("s", "ms", "us", "ns"):
            channel = "time"
        if channel in ("angle", "velocity") and commanded:
            channel = f"command_{channel}"
        elif commanded and channel != "command_velocity":
            channel = None
        if channel is not None and KINDS[channel] == kind:
            return channel, unit
    return None


def split_unit(name: str, kind: str) -> tuple[list[str], str | None]:
    """Split a name into its words in lower case, and the unit of a quantity in which it ends, or
    None."""
    # "(t)" only states that it is a function of time; a second to the power of -1 is one below a
    # slash.
    plain = re.sub(r"\(t\)|(?<=[\s.·*_]s)(\^|\*\*)?(-1|⁻¹)", " ", name, flags=re.IGNORECASE)
    # Words are separated by anything but letters, and where capitals begin, but not within mN.
    parted = re.sub(r"(?<=[^\W\d_A-Z]{2})(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", plain)
    lower = parted.lower().replace("µ", "u").replace("μ", "u")
    words = re.findall(r"[^\W\d_]+|\d+|[°%]|-(?=[\])}>])", lower)
    for start in range(max(len(words) - 3, 0), len(words)):
        ending = [word for word in words[start:] if word != "per"]
        # A single letter is a name.
        if "/".join(ending) in SPELLED[kind] and (start > 0 or len(ending[0]) > 1):
            return words[:start], SPELLED[kind]["/".join(ending)]
    return words, None
