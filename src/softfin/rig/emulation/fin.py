"""The fin behind both emulated devices: what they need of it."""

from typing import NamedTuple, Protocol, runtime_checkable

from softfin.rig.machine import Wrench

COAST_RAD_S2 = 10.0
"""Deceleration of a fin without voltage [rad/s2]; assumed: far less than a quick stop, so that the
two differ."""


class FinMotion(NamedTuple):
    """Motion and force of an emulated fin at one moment."""

    angle: float
    """Angle of the shaft [rad]."""
    velocity: float
    """Angular velocity of the shaft [rad/s]."""
    demand: float
    """Angle of the drive's profile [rad]."""
    current: float
    """Current of the motor [A]."""
    wrench: Wrench
    """Wrench of the fin on its mount, in softfin's axes, as the sensor's own electronics would hand
    it on."""


@runtime_checkable
class EmulatedFin(Protocol):
    """A fin on a shaft that follows a profile, and moves on with its clock; safe to call from
    several threads."""

    def move(self, angle: float, velocity: float) -> None:
        """Go to an angle [rad] at a profile velocity [rad/s], from now on."""

    def halt(self) -> None:
        """Brake and stay."""

    def coast(self) -> None:
        """Go on without a motor, which the water slows down at `COAST_RAD_S2`."""

    def now(self) -> FinMotion:
        """Motion and force at this moment."""
