"""The type `epos2`: a maxon EPOS2 Module 36/2."""

from collections.abc import Callable

from softfin.rig.bus import BusConfig
from softfin.rig.computer import Computer
from softfin.rig.device_type import DriveType
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.drive import Epos2


def _make(
    config: Epos2Config,
    bus: BusConfig | None,
    clock: Computer,
    on_fault: Callable[[str], None] | None,
) -> Epos2:
    assert bus is not None, "RigConfig requires a bus for this drive"
    return Epos2(bus, config, clock, on_fault)


EPOS2 = DriveType(Epos2Config, _make)
