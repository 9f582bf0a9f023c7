"""Interface to a real fin driven by the 100 Hz loop: the rig, ROS 2 topics, or your own machine.

All times are from `time.monotonic` [s], or from the `clock` of the machine if it has one. All calls
come from the thread of the loop, except that any thread may call `stop`.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Float

from softfin.core.clock import REAL, Clock
from softfin.core.quantities import Limits

Wrench: TypeAlias = tuple[float, float, float, float, float, float]
"""Force (x, y, z) [N] and torque (x, y, z) [N m] of the fin on its mount, in softfin's axes."""

WrenchArray = Float[np.ndarray, " 6"]
"""A wrench as an array, in the axes of softfin or of the sensor."""

WRENCH_CHANNELS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Names of the channels of a wrench."""


class Target(NamedTuple):
    """A command to the drive: a `Command` with two Python floats."""

    angle: float
    """Target angle [rad]."""
    velocity: float
    """Velocity towards the target [rad/s], positive."""


class Sample(NamedTuple):
    """The latest readings of the drive and the force sensor, each with its time."""

    time: float
    """Time of the angle [s]; more than one tick ago if no newer reading has arrived."""
    angle: float
    """Shaft angle [rad]."""
    velocity: float
    """Shaft angular velocity [rad/s]."""
    current: float | None
    """Motor current [A]; None if not measured."""
    following_error: float | None
    """Angle demanded by the drive minus the actual angle [rad]; None if not measured."""
    force_time: float
    """Time of the filtered force [s]."""
    wrench: Wrench
    """Filtered force and torque [N, N m]."""
    complaints: tuple[str, ...]
    """Faults reported by the devices, one line each, ending with the fix; empty if there are no
    faults."""
    peak: Wrench | None = None
    """Peak magnitudes of the unfiltered wrench since the previous sample [N, N m]; None if only
    `wrench` is known."""
    voltage: float | None = None
    """Supply voltage of the drive [V]; None if not measured."""


@runtime_checkable
class Machine(Protocol):
    """A fin, its drive and its force sensor."""

    @property
    def name(self) -> str:
        """Name of the machine in records and messages."""

    @property
    def limits(self) -> Limits:
        """Range of accepted commands [rad, rad/s]."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the operator before the fin moves, one line each, e.g. on the connection or on
        unusual settings."""

    @property
    def stop_unconfirmed(self) -> str | None:
        """Warning that the motor may still be on after `stop`, with a fix; None if the motor is
        known to be off."""

    def open(self) -> None:
        """Connect and configure the machine without moving the fin; on failure, close it and raise
        RigError or DeviceError."""

    def read(self) -> Sample:
        """Return the latest sample. Called once per tick; must not wait longer than a few
        milliseconds."""

    def enable(self) -> None:
        """Power the motor, which holds its position; raises DeviceError if the motor cannot be
        powered."""

    def command(self, target: Target) -> None:
        """Start moving to a target and return immediately; raises an error if the machine has not
        been enabled since the last `stop`."""

    def stop(self) -> None:
        """Brake as fast as the drive allows, then disable the motor; may be called repeatedly from
        any thread and never raises."""

    def close(self) -> None:
        """Stop and release both devices; may be called repeatedly and never raises."""

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name, e.g. lost, late or duplicated packets and
        missed heartbeats."""


def machine_clock(machine: object) -> Clock:
    """Return the clock used for the timestamps of a machine: its `clock` attribute if it has one
    (e.g. for simulated time), otherwise the real clock."""
    clock: Clock = getattr(machine, "clock", REAL)
    return clock


def torque_constant(machine: object) -> float | None:
    """Return the torque of a machine per ampere of motor current [N m/A]; None if unknown."""
    # Only a rig has a configured drive.
    constant_nm_a = getattr(machine, "torque_constant_nm_a", None)
    return None if constant_nm_a is None else float(constant_nm_a)


def rotation(frame: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from the sensor axes to softfin's axes; `frame` contains the sensor axes
    along +x and +y, e.g. ``y,-x``.

    The result is a rotation for every frame: if x and y are mirrored, e.g. in ``y,x``, the sensor
    is mounted upside down, so z is reversed.
    """
    rows = np.zeros((2, 3))
    for row, axis in zip(rows, frame.split(","), strict=True):
        row["xy".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    # z = x cross y makes the axes right-handed.
    return np.vstack([rows, np.cross(*rows)])


def rotated(wrench: Sequence[float] | WrenchArray, turn: Float[np.ndarray, "3 3"]) -> Wrench:
    """Return the wrench with its force and torque rotated."""
    # Force and torque are the rows of a (2, 3) array.
    return tuple((np.reshape(wrench, (2, 3)) @ turn.T).ravel().tolist())
