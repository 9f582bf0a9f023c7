"""The type `dynamixel`: a servo of the X series."""

from collections.abc import Callable

from softfin.rig.bus import BusConfig
from softfin.rig.computer import Computer
from softfin.rig.device_type import DriveType
from softfin.rig.devices.dynamixel.config import DynamixelConfig
from softfin.rig.devices.dynamixel.drive import Dynamixel


def _make(
    config: DynamixelConfig,
    bus: BusConfig | None,
    clock: Computer,
    on_fault: Callable[[str], None] | None,
) -> Dynamixel:
    # The servo only answers: its faults are found by `read`, in the loop that reacts to them.
    return Dynamixel(config, clock)


DYNAMIXEL = DriveType(DynamixelConfig, _make)
