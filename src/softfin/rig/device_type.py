"""Types of devices: their configurations and functions that create them."""

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
    """Configuration class of the device."""
    make: Callable[[Settings, BusConfig | None, Computer, Callable[[str], None] | None], Drive]
    """Function that creates a drive from its configuration, the CAN bus of the rig, the computer,
    and a function to call immediately, from any thread, when the drive reports a fault."""


@dataclass(frozen=True)
class ForceSensorType(Generic[Settings]):
    """A type of force sensor."""

    config: type[Settings]
    """Configuration class of the device."""
    make: Callable[[Settings, Computer], StreamedSensor]
    """Function that creates a sensor from its configuration and the computer."""
