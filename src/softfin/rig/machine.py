"""Contract of a real fin that the 100 Hz loop drives: the rig, ROS 2 topics, or your own machine.

All times are from `time.monotonic` [s], or from the machine's own `clock` if it has one. Only the
loop's thread calls a machine, except that any thread may call `stop`.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import Limits

Wrench: TypeAlias = tuple[float, float, float, float, float, float]
"""Force (x, y, z) [N] and torque (x, y, z) [N m] of the fin on its mount, in softfin's axes."""


class Target(NamedTuple):
    """A command to the drive: a Command as two Python floats."""

    angle: float
    """Target angle [rad]."""
    velocity: float
    """Velocity on the way there [rad/s], positive."""


class Sample(NamedTuple):
    """The newest readings of the drive and of the force sensor, each with the time at which it is
    valid."""

    time: float
    """Time of the angle [s]; more than a tick old if no newer reading arrived."""
    angle: float
    """Angle of the shaft [rad]."""
    velocity: float
    """Angular velocity of the shaft [rad/s]."""
    current: float | None
    """Current of the motor [A]; None where it is not measured."""
    following_error: float | None
    """Angle that the drive demands minus the actual one [rad]; None if it is not measured."""
    force_time: float
    """Time of the filtered force [s]."""
    wrench: Wrench
    """Filtered force and torque [N, N m]."""
    complaints: tuple[str, ...]
    """Faults that the devices report, each one line that ends with a fix; empty if there are
    none."""
    peak: Wrench | None = None
    """Peak magnitudes of the unfiltered wrench since the previous sample; None if only `wrench` is
    known."""


@runtime_checkable
class Machine(Protocol):
    """A fin, its drive and its force sensor."""

    @property
    def name(self) -> str:
        """Name of the machine in records and messages."""

    @property
    def limits(self) -> Limits:
        """Range of the commands that it takes [rad, rad/s]."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the operator before it moves, each one line: how it is connected, what is
        unusual."""

    @property
    def stop_unconfirmed(self) -> str | None:
        """Reason why the motor may still be on after `stop`, with a fix; None if it is known to be
        off."""

    def open(self) -> None:
        """Connect and configure, without moving; on failure, close again and raise RigError or
        DeviceError."""

    def read(self) -> Sample:
        """Return the newest sample; called once a tick, waits a few milliseconds at most."""

    def enable(self) -> None:
        """Power the motor, which holds its position; raises DeviceError if the drive does not
        obey."""

    def command(self, target: Target) -> None:
        """Start to move to a target; returns at once, raises if it was not enabled since the last
        `stop`."""

    def stop(self) -> None:
        """Brake as fast as the drive allows, and disable the motor; from any thread, any number of
        times; never raises."""

    def close(self) -> None:
        """Stop, and release both devices; any number of times, never raises."""

    def counters(self) -> dict[str, int]:
        """Return the counts since `open` by name, such as packets lost, late or duplicated, and
        heartbeats missed."""


def machine_clock(machine: object) -> Clock:
    """Return the clock of a machine's timestamps: its own `clock` if it has one, as in simulated
    time, otherwise the real one."""
    clock: Clock = getattr(machine, "clock", REAL)
    return clock


def rotation(frame: str) -> Float[np.ndarray, "3 3"]:
    """Rotation from the sensor's axes into softfin's; `frame` is +x and +y in the sensor's own
    axes, as ``y,-x``.

    It is a rotation whatever the frame: where x and y are mirrored, as in ``y,x``, the sensor looks
    the other way, so its z is reversed.
    """
    rows = np.zeros((2, 3))
    for row, axis in zip(rows, frame.split(","), strict=True):
        row["xy".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return np.vstack([rows, np.cross(*rows)])


def rotated(
    wrench: Sequence[float] | Float[np.ndarray, " 6"], turn: Float[np.ndarray, "3 3"]
) -> Wrench:
    """Force and torque after a rotation."""
    fx, fy, fz, tx, ty, tz = (np.reshape(wrench, (2, 3)) @ turn.T).ravel().tolist()
    return fx, fy, fz, tx, ty, tz
