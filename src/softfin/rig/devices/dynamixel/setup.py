"""Checks a servo and sets it up before use. Apart from the zero, nothing is stored
permanently."""

import struct
from contextlib import suppress

from softfin.core.dynamixel import MODELS
from softfin.core.errors import DeviceError, RigError
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.config import DynamixelConfig, Units, position_range
from softfin.rig.devices.dynamixel.link import SETUP_ANSWER_S, NoAnswer, ServoLink
from softfin.rig.devices.dynamixel.protocol import Entry, error_line
from softfin.rig.drive_safety import Setting, check_settings
from softfin.rig.safety import OVERSHOOT_RAD

WATCHDOG_STOPPED = (
    "servo was stopped by its bus watchdog, because instructions were missing; check its cable, "
    "and check whether the program that moved it paused or ended"
)
RESET = "then run: softfin rig check --reset-fault"


def identify_servo(link: ServoLink, config: DynamixelConfig) -> int:
    """Return the firmware version of the servo; raises RigError if the servo does not respond or is
    a different model."""
    try:
        number, firmware = link.ping()
    except DeviceError as error:
        raise RigError(
            f"{config.port}: no servo with ID {config.id} ({error}; also check that no "
            "other device on this port has this ID)"
        ) from None
    expected = MODELS[config.model].number
    if number != expected:
        names = [name for name, model in MODELS.items() if model.number == number]
        found = names[0] if names else "unsupported"
        raise RigError(
            f"{link.name}: model number is {number} ({found}), but {config.model} has {expected}; "
            "correct drive.model, drive.id or drive.port"
        )
    if firmware < protocol.FIRST_FIRMWARE:
        raise RigError(
            f"{link.name}: firmware {firmware} has no bus watchdog; update it to "
            f"{protocol.FIRST_FIRMWARE} or later with DYNAMIXEL Wizard"
        )
    return firmware


def answer_everything(link: ServoLink) -> None:
    """Make the servo respond to every instruction; a different program may have changed this
    setting."""
    with suppress(NoAnswer):
        link.write(protocol.STATUS_RETURN_LEVEL, protocol.ALL_STATUS_PACKETS)


def settings(config: DynamixelConfig) -> tuple[Setting[Entry], ...]:
    """Return the settings to check before anything is written."""
    lowest, highest = position_range(config)
    outer_lowest, outer_highest = position_range(config, OVERSHOOT_RAD)
    fastest = Units.of(config).speed(config.fastest_rad_s)
    default = protocol.SHUTDOWN_DEFAULT
    return (
        Setting(
            protocol.OPERATING_MODE,
            (protocol.POSITION_MODE,),
            "the servo enforces the fin limits only in position mode; set it to "
            f"{protocol.POSITION_MODE}",
        ),
        # Bit 0 reverses the direction, bit 2 turns velocities into durations, and with bit 3, a
        # target would power a stopped motor.
        Setting(
            protocol.DRIVE_MODE, (0,), "use drive.direction to reverse the fin, and set it to 0"
        ),
        # Bit 0 powers the motor at power-on, before any program is connected. Bit 1 restores the
        # indirect addresses, so softfin would not detect a restart.
        Setting(
            protocol.STARTUP_CONFIGURATION,
            (0,),
            "at power-on, the servo could power its motor or restore old settings; set it to 0",
        ),
        Setting(
            protocol.SHUTDOWN_ERRORS,
            [value for value in range(256) if value & default == default],
            "the servo would not protect itself from overload, shock and heat; set it to "
            f"{int(default)}",
        ),
        Setting(
            protocol.MIN_POSITION_LIMIT,
            range(outer_lowest, lowest + 1),
            f"the rig file needs {outer_lowest} to {lowest}; correct the file, or set the servo to "
            f"{outer_lowest}",
        ),
        Setting(
            protocol.MAX_POSITION_LIMIT,
            range(highest, outer_highest + 1),
            f"the rig file needs {highest} to {outer_highest}; correct the file, or set the servo "
            f"to {outer_highest}",
        ),
        Setting(
            protocol.VELOCITY_LIMIT,
            (fastest,),
            f"fastest_rad_s is {fastest} in servo units; correct the rig file, or set the servo to "
            f"{fastest}",
        ),
    )


def check_setup(link: ServoLink, config: DynamixelConfig) -> None:
    """Raise RigError if the servo is in fault, already powered, or set up differently from the
    rig file."""
    if fault := read_fault(link):
        raise RigError(f"{fault}; {RESET}")
    if link.read(protocol.TORQUE_ENABLE):
        raise RigError(
            "servo is already powered; close the program that controls it, or run: softfin rig stop"
        )
    check_settings(settings(config), link.read, "DYNAMIXEL Wizard")


def read_fault(link: ServoLink) -> str | None:
    """Return the servo fault, or None if there is no fault."""
    if status := link.read(protocol.HARDWARE_ERROR):
        return error_line(status)
    if link.read(protocol.BUS_WATCHDOG) == protocol.WATCHDOG_TRIPPED:
        return WATCHDOG_STOPPED
    return None


def configure(link: ServoLink) -> None:
    """Select the bytes of a status."""
    write(link, protocol.BUS_WATCHDOG, 0)
    addresses = struct.pack(f"<{len(protocol.STATUS_ADDRESSES)}H", *protocol.STATUS_ADDRESSES)
    what = "the indirect addresses"
    link.write_bytes(protocol.INDIRECT_ADDRESS, addresses, SETUP_ANSWER_S, what)
    size = len(addresses)
    if link.read_bytes(protocol.INDIRECT_ADDRESS, size, SETUP_ANSWER_S, what) != addresses:
        raise RigError(f"{link.name}: did not keep {what}; close other programs that use it")


def write(link: ServoLink, entry: Entry, value: int) -> None:
    """Write an entry and read it back; raises RigError if the servo does not keep it."""
    link.write(entry, value)
    kept = link.read(entry)
    if kept != value:
        raise RigError(
            f"servo setting {entry} remained {kept} after {value} was written; close other "
            "programs that use the port"
        )
