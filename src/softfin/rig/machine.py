"""The contract of a fin that moves by itself: what the 100 Hz loop drives, be it a rig, topics of ROS 2 or one's own.

All times are of `time.monotonic` [s], or of the machine's own `clock` where it has one. One thread, that of the loop,
calls everything but `stop`.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import Limits

Wrench: TypeAlias = tuple[float, float, float, float, float, float]
"""Force (x, y, z) [N] and torque (x, y, z) [N m] of the fin on its mount, in softfin's axes."""


class Target(NamedTuple):
    """What a drive is asked to do: a Command as two Python floats."""

    angle: float
    """[rad]"""
    velocity: float
    """Profile velocity on the way there [rad/s], positive."""


class Sample(NamedTuple):
    """The newest that both devices have said, each with the time that it stands for."""

    time: float
    """When the shaft was where it says [s]; older than a tick where no newer reading came."""
    angle: float
    """Of the shaft [rad]."""
    velocity: float
    """Of the shaft [rad/s]."""
    current: float | None
    """Of the motor [A]; None where it is not known."""
    following_error: float | None
    """Angle that the drive demands less the actual one [rad]; None where it is not known."""
    force_time: float
    """The moment that the filtered force stands for [s]."""
    wrench: Wrench
    complaints: tuple[str, ...]
    """What the devices say is wrong, each one line that ends in the way out; none when all is well."""
    peak: Wrench | None = None
    """Largest sizes of the wrench since the sample before, unfiltered; None where no more is known than `wrench`."""


@runtime_checkable
class Machine(Protocol):
    """A fin, its drive and its force sensor."""

    @property
    def name(self) -> str:
        """What to call it in records and messages."""
        ...

    @property
    def limits(self) -> Limits:
        """The commands that it takes [rad, rad/s]."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know before it moves, each one line and no error: how it is connected, what is odd."""
        ...

    @property
    def doubt(self) -> str | None:
        """Why the motor may still be on after `stop`, one line with the way out; None where it is known to be off."""
        ...

    def open(self) -> None:
        """Connect and configure, without moving; raises RigError or DeviceError in one line.

        Closed again on failure.
        """
        ...

    def read(self) -> Sample:
        """The newest sample; called once a tick, waits a few milliseconds at most."""
        ...

    def enable(self) -> None:
        """Ready to move, and hold where it is; raises DeviceError where the drive does not follow."""
        ...

    def command(self, target: Target) -> None:
        """Go there from now on; returns at once.

        Raises where it is not enabled: after a `stop` nothing is taken until the next `enable`.
        """
        ...

    def stop(self) -> None:
        """Brake as fast as the drive may, disable the motor; from any thread, any number of times; never raises."""
        ...

    def close(self) -> None:
        """Stop, let go of both devices; any number of times, never raises."""
        ...

    def counters(self) -> dict[str, int]:
        """What was counted since `open`: packets lost, late, doubled, heartbeats missed .. by name."""
        ...


def clock_of(machine: Any) -> Clock:
    """That of the machine's times: its own `clock`, as an emulated rig in simulated time has one, else the real one."""
    clock = getattr(machine, "clock", None)
    return clock if isinstance(clock, Clock) else REAL
