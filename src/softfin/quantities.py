"""The three records that everything passes on: Command, Reading, Log. SI units, float32 arrays, time before channel.

Axes: thrust that pushes the robot forward is +x. At angle theta the fin points along (-cos theta, +sin theta) from its
shaft. Forces are those of the fin on its mount.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float

RATE_HZ = 100
"""Readings a second: the rate of the paper's logs (Sec. III-A) and of every plant."""

TICK_S = 1 / RATE_HZ

if TYPE_CHECKING:
    from jax import Array

    AnyArray: TypeAlias = Array | np.ndarray
else:

    @runtime_checkable
    class AnyArray(Protocol):
        """In a compiled program a JAX array, in files and figures a NumPy one; float32 in both.

        Told by what it has: what runs on a robot must neither wait for JAX, which takes a second, nor need it.
        """

        @property
        def shape(self) -> tuple[int, ...]:
            """Lengths of its axes."""

        @property
        def dtype(self) -> Any:
            """Type of its numbers."""


class Command(NamedTuple):
    """What the drive is asked to do; held until the next one."""

    angle: Float[AnyArray, "*shape"]
    """Target angle [rad]."""
    velocity: Float[AnyArray, "*shape"]
    """Profile velocity on the way there [rad/s], positive."""


class Reading(NamedTuple):
    """One sample, or a series of samples at 100 Hz."""

    time: Float[AnyArray, "*shape"]
    """Since the plant was initialised [s]."""
    angle: Float[AnyArray, "*shape"]
    """Of the shaft [rad]."""
    velocity: Float[AnyArray, "*shape"]
    """Of the shaft [rad/s]."""
    force: Float[AnyArray, "*shape 2"]
    """Of the fin on its mount, (x, y) [N]."""


class Log(NamedTuple):
    """A recording: row k is what was read at ``reading.time[k]`` and the command that was issued right then.

    The command of row k therefore shows for the first time in the reading of row k + 1.
    """

    command: Command
    reading: Reading


class Limits(NamedTuple):
    """The commands that a plant takes."""

    angle_min: float
    angle_max: float
    velocity_min: float
    velocity_max: float

    def described(self) -> dict[str, float]:
        """For JSON: names with units."""
        return {
            f"{name}_{'rad' if 'angle' in name else 'rad_s'}": float(value) for name, value in self._asdict().items()
        }

    @classmethod
    def of(cls, description: dict[str, float]) -> "Limits":
        """From what `described` gave; raises KeyError where a name is missing."""
        return cls(*(float(description[name]) for name in cls(0, 0, 0, 0).described()))


PAPER_LIMITS = Limits(-np.pi / 2, np.pi / 2, 1.0, np.pi)
"""Sec. III-A: target position in (-pi/2, pi/2) rad, velocity in (1, pi) rad/s."""

AXES = ("x", "y")
