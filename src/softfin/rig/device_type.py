"""Types of devices: the configuration of each and how it is made."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from softfin.rig.bus import BusConfig
from softfin.rig.computer import Computer
from softfin.rig.device import DeviceConfig, Drive
from softfin.rig.streamed_sensor import StreamedSensor

Settings = TypeVar("Settings", bound=DeviceConfig)


@dataclass(frozen=True)
class DriveType(Generic[Settings]):
    """A type of drive."""

    config: type[Settings]
    """Class of its configuration."""
    make: Callable[[Settings, BusConfig | None, Computer, Callable[[str], None] | None], Drive]
    """Makes a drive from its configuration, the rig CAN bus, the computer, and a function to call
    at once when the drive reports a fault, from any thread."""


@dataclass(frozen=True)
class ForceSensorType(Generic[Settings]):
    """A type of force sensor."""

    config: type[Settings]
    """Class of its configuration."""
    make: Callable[[Settings, Computer], StreamedSensor]
    """Makes a sensor from its configuration and the computer."""
