"""What both emulated devices share: a fin that moves by itself, in real time."""

from typing import NamedTuple, Protocol, runtime_checkable

from softfin.rig.machine import Wrench


class Motion(NamedTuple):
    """Of an emulated fin at one moment."""

    angle: float
    """Of the shaft [rad]."""
    velocity: float
    """[rad/s]"""
    demand: float
    """Where the drive's profile is [rad]."""
    current: float
    """Of the motor [A]."""
    wrench: Wrench
    """Of the fin on its mount, in softfin's axes, as the sensor's own electronics would hand it on."""


@runtime_checkable
class EmulatedFin(Protocol):
    """A fin on a shaft that follows a profile; safe to call from several threads."""

    def move(self, angle: float, velocity: float) -> None:
        """Go to an angle [rad] at a profile velocity [rad/s], from now on."""
        ...

    def halt(self) -> None:
        """Brake and stay."""
        ...

    def now(self) -> Motion:
        """As it is at this moment."""
        ...
