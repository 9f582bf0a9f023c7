"""The type `epos2`: a maxon EPOS2 Module 36/2 and its emulator."""

from collections.abc import Callable

from softfin.core.clock import Clock
from softfin.core.quantities import Limits
from softfin.emulation.fin import EmulatedFin
from softfin.rig.bus import BusConfig
from softfin.rig.device import DriveType, EmulatedDevice
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.drive import Epos2


def _make(
    config: Epos2Config,
    bus: BusConfig | None,
    clock: Clock,
    on_fault: Callable[[str], None] | None,
) -> Epos2:
    assert bus is not None, "RigConfig requires a bus for this drive"
    return Epos2(bus, config, clock, on_fault)


def _emulated_config(
    limits: Limits | None, acceleration_rad_s2: float | None, real_time: bool
) -> Epos2Config:
    """Return the configuration of the tank's drive; 500 lines and a gear ratio of 111:1 match the
    steps of the tank's encoder."""
    values: dict[str, float] = {
        "node": 1,
        "encoder_lines": 500,
        "gear_ratio": 111.0,
        "acceleration_rad_s2": acceleration_rad_s2 or 80.0,
        "quick_stop_rad_s2": 80.0,
        "following_error_rad": 0.5,
    }
    if real_time:
        values["heartbeat_s"] = 1.0
    if limits is not None:
        values |= {
            "angle_min_rad": limits.angle_min,
            "angle_max_rad": limits.angle_max,
            "slowest_rad_s": limits.velocity_min,
            "fastest_rad_s": limits.velocity_max,
            # The emulated fin is zeroed where it rests.
            "zero_offset_rad": limits.rest_angle,
        }
    return Epos2Config.build(values, "emulated drive")


def _emulate(config: Epos2Config, bus: BusConfig, fin: EmulatedFin, clock: Clock) -> EmulatedDevice:
    # Imported here because a real rig does not need it.
    from softfin.emulation.epos2.drive import EmulatedDrive

    return EmulatedDrive(bus, config, fin, clock)


EPOS2 = DriveType(Epos2Config, _make, _emulated_config, _emulate)
