"""Interface of the emulated devices to their fin."""

from typing import NamedTuple, Protocol, runtime_checkable

from softfin.rig.machine import Wrench

SENSOR_MOUNTING = "y,-x"
"""Mounting of an emulated sensor; different from softfin's axes, so that a wrong frame cannot go
unnoticed."""

COAST_RAD_S2 = 10.0
"""Deceleration of a fin without voltage [rad/s2]; assumed, far lower than in a quick stop, so that
the two are distinguishable."""


class FinMotion(NamedTuple):
    """Motion and force of an emulated fin at one time."""

    angle: float
    """Shaft angle [rad]."""
    velocity: float
    """Shaft angular velocity [rad/s]."""
    demand: float
    """Profile angle of the drive [rad]."""
    current: float
    """Motor current [A]."""
    wrench: Wrench
    """Wrench of the fin on its mount, in softfin's axes [N, N m], as output by the sensor
    electronics."""


@runtime_checkable
class EmulatedFin(Protocol):
    """A fin on a shaft that follows a profile and advances with its clock; must be thread-safe."""

    def move(self, angle: float, velocity: float) -> None:
        """Move to an angle [rad] at a profile velocity [rad/s]."""

    def halt(self) -> None:
        """Brake and hold."""

    def coast(self) -> None:
        """Coast without the motor, decelerating at `COAST_RAD_S2`."""

    def now(self) -> FinMotion:
        """Return the current motion and force."""
