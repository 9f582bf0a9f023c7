"""Interface of the emulated devices, and the configuration and constructor of each type."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from softfin.core.choices import LOOPBACK
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.core.power import EC_MAX_30
from softfin.emulation.axia80 import EmulatedAxia80
from softfin.emulation.dynamixel import EmulatedServo
from softfin.emulation.epos2.drive import EmulatedDrive
from softfin.emulation.fin import SENSOR_MOUNTING, EmulatedFin
from softfin.emulation.lines import EMULATED_UDP_PORT, EmulatedLines
from softfin.rig.computer import Computer
from softfin.rig.device import DriveConfig, ForceSensorConfig
from softfin.rig.device_type import DriveType, ForceSensorType
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.registry import find_device
from softfin.tank import Tank

MOTOR_VALUES = {
    "torque_constant_nm_a": EC_MAX_30.torque_constant_nm_a * EC_MAX_30.gear_efficiency,
    "gear_efficiency": EC_MAX_30.gear_efficiency,
    "winding_ohm": EC_MAX_30.winding_ohm,
}
"""Motor of the emulated drives, as in the file of a real rig."""


class Emulator(NamedTuple):
    """Emulation of a type of device.

    Emulators run from construction until `close`. `address()` returns the address fields of the
    device configuration. For a drive, `remembered()` returns the state that a power loss would
    erase, and `recall` restores this state.
    """

    values: JsonObject
    """The configuration, without the limits of a drive."""
    start: Callable[..., Any]
    """Function that starts an emulator with a configuration, the bus of a drive, a fin and the
    computer."""


def _start_axia80(config: Axia80Config, fin: EmulatedFin, clock: Computer) -> EmulatedAxia80:
    # In simulated time, the sensor can use its factory ports, because they exist only within this
    # process.
    rdt_port, http_port = (config.rdt_port, config.http_port) if clock.is_simulated else (0, 0)
    return EmulatedAxia80(fin, rdt_port, http_port, frame=SENSOR_MOUNTING, clock=clock)


def _start_lines(config: LinesConfig, fin: EmulatedFin, clock: Computer) -> EmulatedLines:
    udp_port = config.udp_port if clock.is_simulated else None
    return EmulatedLines(fin, config.rate_hz, clock, udp_port, config.columns[1:])


DRIVES = {
    "epos2": Emulator(
        {
            "node": 1,
            # 500 lines and a gear ratio of 111:1 match the steps of the tank's encoder.
            "encoder_lines": 500,
            "gear_ratio": 111.0,
            "following_error_rad": 0.5,
            **MOTOR_VALUES,
        },
        lambda config, bus, fin, clock: EmulatedDrive(bus, config, fin, clock),
    ),
    "dynamixel": Emulator(
        {
            "port": "simulated",
            "model": "XM430-W350",
            "id": 1,
            **MOTOR_VALUES,
        },
        lambda config, bus, fin, clock: EmulatedServo(config, fin, clock),
    ),
}
"""Emulated drives, by type."""

SENSORS = {
    "axia80": Emulator({"address": LOOPBACK}, _start_axia80),
    "lines": Emulator(
        {
            "columns": ["count", "force_x", "force_y", "torque_z"],
            "rate_hz": 320.0,
            "filter_delay_s": 0.0,
            "address": LOOPBACK,
            "udp_port": EMULATED_UDP_PORT,
        },
        _start_lines,
    ),
}
"""Emulated force sensors, by type."""


def find_emulator(emulators: Mapping[str, Emulator], name: str) -> Emulator:
    """Return the emulator of a type of device; raises RigError."""
    if name not in emulators:
        raise RigError(f"type {name!r}: has no emulator; use one of {', '.join(emulators)}")
    return emulators[name]


def drive_config(name: str, tank: Tank | None, real_time: bool) -> DriveConfig:
    """Return the configuration of an emulated drive with the command limits and the acceleration of
    a tank; raises RigError or ConfigurationError."""
    kind = find_device(DriveType, name)
    acceleration = 80.0 if tank is None else float(tank.drive.acceleration)
    values = find_emulator(DRIVES, name).values | {
        "type": name,
        "acceleration_rad_s2": acceleration,
        "quick_stop_rad_s2": max(80.0, acceleration),
    }
    if real_time:
        values["heartbeat_s"] = 1.0
    if tank is not None:
        limits = tank.limits
        values |= {
            "angle_min_rad": limits.angle_min,
            "angle_max_rad": limits.angle_max,
            "slowest_rad_s": limits.velocity_min,
            "fastest_rad_s": limits.velocity_max,
        }
        # The emulated fin is zeroed at its rest position.
        if "zero_offset_rad" in kind.config.model_fields:
            values["zero_offset_rad"] = limits.rest_angle
        elif limits.rest_angle != 0:
            raise ConfigurationError(
                f"tank: its angle range, {limits.angle_min:g} to {limits.angle_max:g} rad, must "
                f"contain 0 for an emulated drive of type {name}; use --drive epos2"
            )
    config: DriveConfig = kind.config.build(values, "emulated drive")
    return config


def sensor_config(name: str) -> ForceSensorConfig:
    """Return the configuration of an emulated sensor, mounted as `SENSOR_MOUNTING`; raises
    RigError."""
    kind = find_device(ForceSensorType, name)
    values = find_emulator(SENSORS, name).values | {"type": name, "frame": SENSOR_MOUNTING}
    config: ForceSensorConfig = kind.config.build(values, "emulated sensor")
    return config
