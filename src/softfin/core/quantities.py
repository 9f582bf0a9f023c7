"""The three records that all packages exchange: Command, Reading and Log. SI units, float32 arrays,
time before channel.

Axes: +x is the direction of the thrust that pushes the robot forward. At angle theta, the fin
points along (-cos theta, +sin theta) from its shaft. Forces act from the fin on its mount.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float

RATE_HZ = 100
"""Readings per second: the rate of the paper's logs (Sec. III-A) and of every plant."""

TICK_S = 1 / RATE_HZ

DAY = 24 * 3600 * RATE_HZ
"""Period of the day counter [ticks]. A plant counts ticks in 32 bits and reports time in single
precision; neither can represent Unix time."""


def tick_at(time_s: float) -> int:
    """Return the tick within the day for a time on any clock, such as the clock of a log or a
    computer."""
    return round(time_s * RATE_HZ) % DAY


if TYPE_CHECKING:
    from jax import Array

    AnyArray: TypeAlias = Array | np.ndarray
else:

    @runtime_checkable
    class AnyArray(Protocol):
        """Array of float32: a JAX array in a compiled program, a NumPy array in files and figures.

        It is recognised by its attributes because code on a robot must not depend on JAX, whose
        import takes a second.
        """

        @property
        def shape(self) -> tuple[int, ...]:
            """Lengths of the axes."""

        @property
        def dtype(self) -> Any:
            """Type of the elements."""


class Command(NamedTuple):
    """Target for the drive, held until the next command."""

    angle: Float[AnyArray, "*shape"]
    """Target angle [rad]."""
    velocity: Float[AnyArray, "*shape"]
    """Profile velocity towards the target [rad/s], positive."""


class Reading(NamedTuple):
    """One sample, or a series of samples at 100 Hz."""

    time: Float[AnyArray, "*shape"]
    """Time since initialisation of the plant [s]."""
    angle: Float[AnyArray, "*shape"]
    """Angle of the shaft [rad]."""
    velocity: Float[AnyArray, "*shape"]
    """Angular velocity of the shaft [rad/s]."""
    force: Float[AnyArray, "*shape 2"]
    """Force of the fin on its mount, (x, y) [N]."""


class Log(NamedTuple):
    """A recording: row k contains the reading at ``reading.time[k]`` and the command issued at that
    time.

    The command of row k therefore first affects the reading of row k + 1.
    """

    command: Command
    reading: Reading
    channels: Mapping[str, Float[AnyArray, "rows"]] = {}
    """Additional measured channels, keyed by log file column (`softfin.core.log_channels`)."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.reading.time)

    @property
    def columns(self) -> tuple[AnyArray, ...]:
        """Columns that every log file has after the time, ``(rows,)`` each: command angle, command
        velocity, angle, velocity, force x and force y."""
        _, angle, velocity, force = self.reading
        return (*self.command, angle, velocity, *np.moveaxis(np.asarray(force), -1, 0))


MAX_ANGLE_RAD = 2 * np.pi
"""Maximum angle of any fin [rad]: one revolution in either direction."""

MAX_VELOCITY_RAD_S = 50.0
"""Maximum velocity of any fin [rad/s]: eight revolutions per second, far more than any fin in
water."""

REST_TOLERANCE_RAD = 0.03
"""Distance from angle 0 within which an angle is treated as 0 [rad]; random commands rarely come
closer to the end of a range."""

ALLOWED_LIMITS = (
    f"the limits of a fin must be finite, with -{MAX_ANGLE_RAD:.3f} <= angle_min < angle_max <= "
    f"{MAX_ANGLE_RAD:.3f} rad and 0 <= velocity_min <= velocity_max <= {MAX_VELOCITY_RAD_S:g} "
    "rad/s, and 0 < velocity_max"
)


LIMIT_KEYS = ("angle_min_rad", "angle_max_rad", "velocity_min_rad_s", "velocity_max_rad_s")
"""Keys of `Limits` in JSON."""


class Limits(NamedTuple):
    """Range of the commands that a plant accepts; `problem` checks whether the range is plausible
    for a fin."""

    angle_min: float
    angle_max: float
    velocity_min: float
    velocity_max: float

    def to_dict(self) -> dict[str, float]:
        """Convert for JSON, with units in the names."""
        return dict(zip(LIMIT_KEYS, map(float, self), strict=True))

    @classmethod
    def of(cls, description: object) -> "Limits":
        """Build from the result of `to_dict`; raises ValueError with the allowed values if it is
        invalid."""
        values = []
        for name in LIMIT_KEYS:
            value = description.get(name) if isinstance(description, dict) else None
            # In Python, `true` is an int, and an int can be larger than any float.
            if not (isinstance(value, float) or (type(value) is int and abs(value) < 1e300)):
                met = "missing" if value is None else repr(value)[:80]
                raise ValueError(f"limits: {name} is {met}; it must be a number; {ALLOWED_LIMITS}")
            values.append(float(value))
        limits = cls(*values)
        if problem := limits.problem():
            raise ValueError(problem)
        return limits

    @property
    def rest_angle(self) -> float:
        """Angle at which every experiment, episode and log starts [rad]: 0, where the fin points
        along -x, or the end of the range that is closest to 0."""
        return min(max(0.0, self.angle_min), self.angle_max)

    def problem(self) -> str | None:
        """Describe the problem with these limits and the allowed values; None if they are plausible
        for a fin. Both velocities are equal for a drive without a velocity command."""
        named = self.to_dict()
        for name, value in named.items():
            low, high = (
                (0, MAX_VELOCITY_RAD_S) if "velocity" in name else (-MAX_ANGLE_RAD, MAX_ANGLE_RAD)
            )
            # Written so that NaN fails: it is not within any range.
            if not low <= value <= high:
                return f"limits: {name} is {value:g}; {ALLOWED_LIMITS}"
        is_ordered = self.angle_min < self.angle_max and self.velocity_min <= self.velocity_max
        if not is_ordered or self.velocity_max == 0:
            return (
                f"limits: {', '.join(f'{name} is {value:g}' for name, value in named.items())}; "
                f"{ALLOWED_LIMITS}"
            )
        return None


def action_to_command(limits: Limits, action: Any) -> Command:
    """Map an action in [-1, 1]^2 (two numbers or an array of any library) to the limits."""
    # [-1, 1] -> [0, 1] -> [min, max]
    angle = (action[0] + 1) / 2
    velocity = (action[1] + 1) / 2
    return Command(
        limits.angle_min + angle * (limits.angle_max - limits.angle_min),
        limits.velocity_min + velocity * (limits.velocity_max - limits.velocity_min),
    )


def command_limits(logs: Sequence[Log]) -> Limits:
    """Return the range of the commands in logs; it sets the limits of a surrogate fitted to these
    logs.

    A range that ends close to angle 0 is extended to it: random commands never quite reach the end
    of a range, but the fin rests there.
    """
    commands = np.concatenate([np.stack(log.command) for log in logs], axis=1, dtype=np.float32)
    angle_min, velocity_min = commands.min(axis=1).tolist()
    angle_max, velocity_max = commands.max(axis=1).tolist()
    if 0 < angle_min <= REST_TOLERANCE_RAD:
        angle_min = 0.0
    if -REST_TOLERANCE_RAD <= angle_max < 0:
        angle_max = 0.0
    return Limits(angle_min, angle_max, velocity_min, velocity_max)


PAPER_LIMITS = Limits(-np.pi / 2, np.pi / 2, 1.0, np.pi)
"""Sec. III-A: target position in (-pi/2, pi/2) rad, velocity in (1, pi) rad/s."""

Axis: TypeAlias = Literal["x", "y"]
AXES: tuple[Axis, Axis] = ("x", "y")
