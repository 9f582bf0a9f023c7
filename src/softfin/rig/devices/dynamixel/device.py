"""The type `dynamixel`: a servo of the X series, and its emulator."""

from collections.abc import Callable

from softfin.core.clock import Clock
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import Limits
from softfin.emulation.fin import EmulatedFin
from softfin.rig.bus import BusConfig
from softfin.rig.device import DriveType, EmulatedDevice
from softfin.rig.devices.dynamixel.config import DynamixelConfig
from softfin.rig.devices.dynamixel.drive import Dynamixel


def _make(
    config: DynamixelConfig,
    bus: BusConfig | None,
    clock: Clock,
    on_fault: Callable[[str], None] | None,
) -> Dynamixel:
    # The servo only answers: its faults are found by `read`, in the loop that reacts to them.
    return Dynamixel(config, clock)


def _emulated_config(
    limits: Limits | None, acceleration_rad_s2: float | None, real_time: bool
) -> DynamixelConfig:
    acceleration = acceleration_rad_s2 or 80.0
    values: dict[str, object] = {
        "port": "simulated",
        "model": "XM430-W350",
        "id": 1,
        "acceleration_rad_s2": acceleration,
        "quick_stop_rad_s2": max(80.0, acceleration),
    }
    if real_time:
        values["heartbeat_s"] = 1.0
    if limits is not None:
        if limits.rest_angle != 0:
            raise ConfigurationError(
                f"tank: its range of angles, {limits.angle_min:g} to {limits.angle_max:g} rad, "
                "must contain 0 for an emulated Dynamixel; use --drive epos2"
            )
        values |= {
            "angle_min_rad": limits.angle_min,
            "angle_max_rad": limits.angle_max,
            "slowest_rad_s": limits.velocity_min,
            "fastest_rad_s": limits.velocity_max,
        }
    return DynamixelConfig.build(values, "emulated drive")


def _emulate(
    config: DynamixelConfig, bus: BusConfig, fin: EmulatedFin, clock: Clock
) -> EmulatedDevice:
    # Imported here because a real rig does not need it.
    from softfin.emulation.dynamixel import EmulatedServo

    return EmulatedServo(config, fin, clock)


DYNAMIXEL = DriveType(DynamixelConfig, _make, _emulated_config, _emulate)
