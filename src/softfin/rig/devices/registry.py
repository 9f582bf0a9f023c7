"""The known types of drives and force sensors: softfin's own types, and types from other installed
packages through the entry point group `softfin.devices`."""

from collections.abc import Mapping
from typing import Any, TypeVar

from softfin.core.configuration import Configuration
from softfin.core.errors import RigError, one_line
from softfin.rig.device_type import DriveType, ForceSensorType
from softfin.storage.plugins import list_plugins

GROUP = "softfin.devices"
"""Entry point group; the name of an entry point is the `type` in a rig file, and its object is a
`DriveType` or a `ForceSensorType`."""

DEVICES = {
    "dynamixel": "softfin.rig.devices.dynamixel.drive:DYNAMIXEL",
    "epos2": "softfin.rig.devices.epos2.drive:EPOS2",
    "axia80": "softfin.rig.devices.axia80.sensor:AXIA80",
    "lines": "softfin.rig.devices.lines.sensor:LINES",
}
"""Built-in devices; their modules are imported when they are used."""

Kind = TypeVar("Kind", DriveType[Any], ForceSensorType[Any])


def choose_config(
    kind: type[Kind], default: str, values: Mapping[str, object]
) -> type[Configuration]:
    """Return the configuration class for a device in a rig file, in which the type may be omitted;
    raises ValueError if the type is unknown."""
    try:
        found: DriveType[Any] | ForceSensorType[Any] = find_device(
            kind, str(values.get("type", default))
        )
    except RigError as error:
        raise ValueError(str(error)) from None
    return found.config


def find_device(kind: type[Kind], name: str) -> Kind:
    """Return a type of drive or force sensor; raises RigError if it is unknown or cannot be
    imported."""
    devices = list_plugins(GROUP, DEVICES)
    what = "drive" if kind is DriveType else "force sensor"
    found = devices.get(name)
    if found is None:
        raise RigError(
            f"type {name!r}: unknown {what}; use one of {', '.join(sorted(devices))}, or install "
            "the package for the device"
        )
    try:
        device = found.load()
    except Exception as error:
        # The package of a device may raise any exception.
        raise RigError(
            f"type {name!r}: {found.value} cannot be imported ({one_line(error)}); reinstall the "
            "package for the device"
        ) from None
    if not isinstance(device, kind):
        raise RigError(f"type {name!r}: {found.value} is not a {what}; use a different type")
    return device
