"""The known types of drives and force sensors: softfin's own, and those of other installed packages
through the entry point group `softfin.devices`."""

import contextlib
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from typing import Any, TypeVar

from softfin.core.errors import RigError, one_line
from softfin.rig.device import DriveConfig, DriveType, ForceSensorConfig, ForceSensorType
from softfin.storage.plugins import list_plugins

GROUP = "softfin.devices"
"""Entry point group; the name of an entry point is the `type` in a rig's file, and its object is a
`DriveType` or a `ForceSensorType`."""

DEVICES = {
    "dynamixel": "softfin.rig.devices.dynamixel.device:DYNAMIXEL",
    "epos2": "softfin.rig.devices.epos2.device:EPOS2",
    "axia80": "softfin.rig.devices.axia80.device:AXIA80",
    "lines": "softfin.rig.devices.lines.device:LINES",
    "ros2": "softfin.rig.devices.ros2.device:ROS2",
}
"""softfin's own devices; their modules are imported when they are used."""

Kind = TypeVar("Kind", DriveType[Any], ForceSensorType[Any])


def find_drive(name: str) -> DriveType[Any]:
    """Return a type of drive; raises RigError if it is unknown or cannot be imported."""
    return _find(name, DriveType, "drive")


def find_force_sensor(name: str) -> ForceSensorType[Any]:
    """Return a type of force sensor; raises RigError if it is unknown or cannot be imported."""
    return _find(name, ForceSensorType, "force sensor")


def choose_drive(values: Mapping[str, object]) -> type[DriveConfig]:
    """Return the class of a drive's configuration in a rig's file; raises ValueError."""
    config: type[DriveConfig] = _choose(values, DriveConfig, DriveType, "drive").config
    return config


def choose_force_sensor(values: Mapping[str, object]) -> type[ForceSensorConfig]:
    """Return the class of a sensor's configuration in a rig's file; raises ValueError."""
    config: type[ForceSensorConfig] = _choose(
        values, ForceSensorConfig, ForceSensorType, "force sensor"
    ).config
    return config


def _choose(
    values: Mapping[str, object],
    base: type[DriveConfig] | type[ForceSensorConfig],
    kind: type[Kind],
    what: str,
) -> Kind:
    try:
        return _find(str(values.get("type", base.DEFAULT_TYPE)), kind, what)
    except RigError as error:
        raise ValueError(str(error)) from None


def _find(name: str, kind: type[Kind], what: str) -> Kind:
    devices = list_plugins(GROUP, DEVICES)
    found = devices.get(name)
    if found is None:
        available = ", ".join(_list_types(devices, kind))
        raise RigError(
            f"type {name!r}: unknown {what}; use one of {available}, or install the package of the "
            "device"
        )
    try:
        device = found.load()
    except Exception as error:
        # The package of a device may raise anything.
        raise RigError(
            f"type {name!r}: {found.value} cannot be imported ({one_line(error)}); reinstall the "
            "package of the device"
        ) from None
    if not isinstance(device, kind):
        raise RigError(f"type {name!r}: {found.value} is not a {what}; use another type")
    return device


def _list_types(devices: Mapping[str, EntryPoint], kind: type[Kind]) -> list[str]:
    """Return the names of all drives or of all force sensors."""
    names = []
    for name, entry_point in devices.items():
        # A package that cannot be imported is reported when its device is chosen.
        with contextlib.suppress(Exception):
            if isinstance(entry_point.load(), kind):
                names.append(name)
    return sorted(names)
