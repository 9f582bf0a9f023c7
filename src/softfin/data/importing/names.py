"""Recognize the channel and the unit in a column name.

All file formats with named columns share these tables of words and units. Case and separators are
ignored: ``cmd angle [deg]``, ``CmdAngle_deg`` and ``COMMAND-ANGLE (deg)`` are equivalent.
"""

import itertools
import math
import re
from typing import Literal, get_args

from softfin.core.dynamixel import TICKS_PER_TURN, VELOCITY_UNIT_RPM
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS, LOG_COLUMNS

LogChannel = Literal[
    "time", "command_angle", "command_velocity", "angle", "velocity", "force_x", "force_y"
]

FurtherChannel = Literal["force_z", "torque_x", "torque_y", "torque", "current"]

Channel = Literal[LogChannel, FurtherChannel]

CHANNELS: tuple[str, ...] = get_args(LogChannel)
"""Channels of every log. A recording may lack the velocity; it may also lack the time and the
commanded velocity if options set them."""

FURTHER: dict[str, str] = dict(
    zip(get_args(FurtherChannel), (*LOAD_CHANNELS, CURRENT_CHANNEL), strict=True)
)
"""Names in a log of the channels that it may also contain."""

OWN_NAMES = dict(zip(LOG_COLUMNS, CHANNELS, strict=True)) | {
    name: channel for channel, name in FURTHER.items()
}
"""Channels by softfin's own column names."""

KINDS: dict[str, str] = {
    channel: re.sub("command_|_[xyz]$", "", channel) for channel in (*CHANNELS, *FURTHER)
}
"""Physical quantity of each channel."""

RPM = 2 * math.pi / 60
"""One revolution per minute [rad/s]."""

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "angle": {
        "rad": 1.0,
        "mrad": 1e-3,
        "deg": math.pi / 180,
        "turn": 2 * math.pi,
        # Raw position of a Dynamixel of the X series; as a velocity, its raw velocity.
        "dynamixel": 2 * math.pi / TICKS_PER_TURN,
    },
    "velocity": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.pi / 180,
        "turn/s": 2 * math.pi,
        "rpm": RPM,
        "dynamixel": VELOCITY_UNIT_RPM * RPM,
    },
    "force": {
        "N": 1.0,
        "mN": 1e-3,
        "cN": 1e-2,
        "kN": 1e3,
        "gf": 9.80665e-3,
        "kgf": 9.80665,
        "lbf": 4.4482216152605,
        "ozf": 4.4482216152605 / 16,
    },
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Ncm": 1e-2},
    "current": {"A": 1.0, "mA": 1e-3},
}
"""Conversion factors to the SI unit, by quantity and unit; the SI unit comes first."""

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
    "turn": "turn turns rev revs revolution revolutions rotation rotations",
    "rpm": "rpm 1/min r/min rev/min revs/min revolutions/minute",
    "N": "n newton newtons",
    "mN": "mn millinewton millinewtons",
    "cN": "cn centinewton centinewtons",
    "kN": "kn kilonewton kilonewtons",
    # A force in units of mass is the weight of that mass.
    "gf": "gf g gram grams gr gram/force grams/force",
    "kgf": "kgf kg kgs kilogram kilograms kilo kilos kp kilopond kilogram/force kilograms/force",
    "lbf": "lbf lb lbs pound pounds pound/force pounds/force",
    "ozf": "ozf oz ounce ounces ounce/force",
    # The words of a unit are joined by slashes, so n/m is N m, N.m or N·m.
    "Nm": "nm n/m newtonmeter newtonmeters newton/meter newton/meters",
    "mNm": "mnm mn/m",
    "Ncm": "ncm n/cm",
    "A": "a amp amps ampere amperes",
    "mA": "ma milliamp milliamps milliampere milliamperes",
}
"""Spellings of each unit in lower case. Spellings of velocity units are generated from the
spellings of an angle unit, a slash and the spellings of a second."""

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
"""Words that mark an angle or a velocity as commanded. Without an angle or velocity word, they mean
the commanded angle, or the commanded velocity if the unit is one; "ref" and "reference" do not,
because they could also mean the reference force."""

PHRASES = {
    "time": ["time", "t", "timestamp", "stamp", "time stamp", "datetime", "date time"],
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
    # "moving speed" is a register in Dynamixel's protocol 1.
    "command_velocity": ["profile velocity", "profile vel", "profile speed", "moving speed"],
    "force_x": ["force x", "fx", "f x"],
    "force_y": ["force y", "fy", "f y"],
    # The z axis is the shaft.
    "torque": ["torque", "torque z", "moment z", "tz", "mz"],
    "current": ["current"],
}
"""Names of each channel; their words may have any order. With one of `COMMAND_WORDS`, a name means
the commanded channel."""

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
    # rostopic echo -p prefixes all names.
    "field",
    "utc",
    "local",
}
"""Words that do not change the meaning of a name."""

UNIT_FACTOR = r"\d+(?:\.\d+)?(?:e[-+]?\d+)?"

RAW_UNITS = "raw|counts?|ticks?|adc|lsb|m?v|volts?"
"""Units at the end of a name that have no fixed conversion."""

ROSTOPIC_TIME = "%time"
"""First column of ``rostopic echo -p``, in nanoseconds; the other times are in the message."""

_PHRASES: dict[tuple[str, ...], str] = {}
for _channel, _names in PHRASES.items():
    _PHRASES |= {tuple(sorted(_name.split())): _channel for _name in _names}

_KNOWN_WORDS = COMMAND_WORDS | NEUTRAL_WORDS | {*itertools.chain(*_PHRASES), "z"}


def _spellings(kind: str) -> dict[str, str]:
    spelled: dict[str, str] = {}
    for unit in UNITS[kind]:
        spelled |= dict.fromkeys(SPELLINGS.get(unit, "").split(), unit)
    if kind == "velocity":
        for unit in UNITS["angle"]:
            angles = SPELLINGS.get(unit, "").split()
            for pair in itertools.product(angles, SPELLINGS["s"].split()):
                spelled["/".join(pair)] = f"{unit}/s"
        spelled |= {"dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "rps": "turn/s"}
    return spelled


SPELLED = {kind: _spellings(kind) for kind in UNITS}
"""Units by quantity and spelling (lower case)."""


def read_name(name: str) -> tuple[str, str | None] | None:
    """Return channel and unit (or None) of a column name; None unless every word is known."""
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
        # A unit alone, such as "ms", means time; but "min" is more often a minimum.
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
    """Split a name into its lowercase words and its trailing unit (None without a unit)."""
    if name == ROSTOPIC_TIME:
        return ["time"], "ns"
    # Drop "(t)", which only marks a function of time, and the exponent of "rad s^-1", because the
    # unit words are joined by a slash below.
    plain = re.sub(r"\(t\)|^%|(?<=[\s.·*_]s)(\^|\*\*)?(-1|⁻¹)", " ", name, flags=re.IGNORECASE)
    # Words end at non-letters and before capitals (CmdAngle), but not within units such as mN.
    parted = re.sub(r"(?<=[^\W\d_A-Z]{2})(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", plain)
    lower = parted.lower().replace("µ", "u").replace("μ", "u")
    words = re.findall(rf"[^\W\d_]+|{UNIT_FACTOR}|[°%]|-(?=[\])}}>])", lower)
    for start in range(max(len(words) - 3, 0), len(words)):
        ending = [word for word in words[start:] if word != "per"]
        # A single letter that is the entire name is not a unit: "s" or "N" could mean anything.
        if "/".join(ending) in SPELLED[kind] and (start > 0 or len(ending[0]) > 1):
            unit = SPELLED[kind]["/".join(ending)]
            factor = words[start - 1] if start else ""
            # "[0.229 rpm]" or "0.229rpm" is a multiple of the unit; in "angle 2 [deg]", 2 is not.
            if "." in factor or re.search(
                rf"[\[({{<]\s*{UNIT_FACTOR}\s*{re.escape(ending[0])}", lower
            ):
                return words[: start - 1], f"{factor} {unit}"
            return words[:start], unit
    return words, None


def unit_factor(kind: str, unit: str) -> float:
    """Return the factor that converts a unit, or a multiple such as "0.229 rpm", to the SI unit."""
    factor, _, plain = unit.rpartition(" ")
    return float(factor or 1) * UNITS[kind][plain]


def split_unknown_unit(name: str, kind: str) -> tuple[str, str] | None:
    """Split a name that ends in a unit that softfin does not know, if it does."""
    ending = re.fullmatch(rf"(.*?)(?:[\[({{<](.*)[\])}}>]\s*|[\W_]({RAW_UNITS}))", name.lower())
    if ending is None or split_unit(name, kind)[1] is not None:
        return None
    rest, bracketed, raw = ending.groups()
    words = re.findall(r"[^\W\d_]+", bracketed or raw or "")
    if set(words) <= _KNOWN_WORDS:
        return None
    return rest, (bracketed or raw).strip()
