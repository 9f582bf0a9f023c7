"""Before an EPOS2 may move: is it the one of the rig's file, does it hold our limits? All is written and read back.

Nothing here moves the motor, and nothing is stored for good: the drive forgets it at power-down.
"""

from softfin.core.errors import DeviceError, RigError
from softfin.rig.epos2 import protocol
from softfin.rig.epos2.config import Epos2Config, Units
from softfin.rig.epos2.connection import CanConnection
from softfin.rig.epos2.protocol import Object, fault_line

NO_REMOTE_REQUEST = 1 << 30
HEARTBEATS = 10
"""Heartbeats of the drive in the time after which silence means that it is gone."""
HOME = {protocol.HOMING_METHOD: protocol.HOME_HERE, protocol.HOME_OFFSET: 0, protocol.HOME_POSITION: 0}
"""What makes the present position zero."""


def identify(connection: CanConnection, config: Epos2Config) -> None:
    """Raise RigError where the node does not answer, or is not a drive."""
    try:
        device = connection.read(protocol.DEVICE_TYPE)
    except DeviceError:
        raise RigError(
            f"no drive answers as node {config.node} on {connection.name}; compare drive.node with the drive's "
            "switches, look at supply, cable, termination and bus.bitrate"
        ) from None
    if device & 0xFFFF != protocol.SERVO_DRIVE:
        raise RigError(
            f"node {config.node} is not a drive: its device type is 0x{device:08X}, not CiA {protocol.SERVO_DRIVE}; "
            "set drive.node of the rig's file to the EPOS2's"
        )


def fault_of(connection: CanConnection) -> str | None:
    """The fault that the drive is in, asked for; None when it is in none."""
    if protocol.decode(connection.read(protocol.STATUSWORD)) not in protocol.FAULT_STATES:
        return None
    if connection.read(protocol.ERROR_COUNT):
        return fault_line(connection.read(protocol.NEWEST_ERROR) & 0xFFFF)
    return "drive is in fault without an entry in its error history"


def check(connection: CanConnection, config: Epos2Config) -> None:
    """Raise RigError for a drive in fault, enabled by somebody else, or set up otherwise than the rig's file says."""
    if fault := fault_of(connection):
        raise RigError(f"{fault}; then run: softfin rig check --reset-fault")
    word = connection.read(protocol.STATUSWORD)
    state = protocol.decode(word)
    if state not in protocol.UNPOWERED:
        words = state.words if state else f"not of an EPOS2 (statusword 0x{word:04X})"
        raise RigError(f"drive is {words} already; close the program that drives it, or switch it off and on")
    motor = connection.read(protocol.MOTOR_TYPE)
    if motor not in protocol.BRUSHLESS:
        allowed = " or ".join(f"{number} ({name})" for number, name in protocol.BRUSHLESS.items())
        raise RigError(f"drive's motor type is {motor}; an EC-max has {allowed}: set the motor up in EPOS Studio")
    lines = connection.read(protocol.ENCODER_LINES)
    if lines != config.encoder_lines:
        raise RigError(
            f"drive is set to an encoder of {lines} lines, the rig's file to encoder_lines {config.encoder_lines}; "
            "correct whichever is wrong, or every angle is"
        )


def configure(connection: CanConnection, config: Epos2Config) -> None:
    """Write limits, profile, mode, heartbeat and process data; the node must be pre-operational."""
    units = Units.of(config)
    ends = sorted((units.counts(config.angle_min_rad), units.counts(config.angle_max_rad)))
    values = {
        protocol.HEARTBEAT_CONSUMER: 0,
        protocol.POSITION_MIN: ends[0],
        protocol.POSITION_MAX: ends[1],
        protocol.FOLLOWING_ERROR: round(config.following_error_rad * units.counts_per_rad),
        protocol.FASTEST: units.rpm(config.fastest_rad_s),
        protocol.PROFILE_VELOCITY: units.rpm(config.slowest_rad_s),
        protocol.ACCELERATION: units.rpm(config.acceleration_rad_s2),
        protocol.DECELERATION: units.rpm(config.acceleration_rad_s2),
        protocol.QUICK_STOP_DECELERATION: units.rpm(config.quick_stop_rad_s2),
        protocol.PROFILE_TYPE: 0,
    }
    if config.current_limit_a is not None:
        values[protocol.CURRENT_LIMIT] = round(1000 * config.current_limit_a)
    for entry, value in values.items():
        write(connection, entry, value)
    set_mode(connection, protocol.PROFILE_POSITION)
    write(connection, protocol.HEARTBEAT_PRODUCER, round(1000 * config.heartbeat_s / HEARTBEATS))
    for first, pdos, cob_id, transmission in (
        (0x1800, protocol.SENT, protocol.TPDO[0], protocol.ON_SYNC),
        (0x1400, protocol.TAKEN, protocol.RPDO[0], protocol.AT_ONCE),
    ):
        # All four of each kind: what else the drive was once told to send and take is turned off.
        for place in range(4):
            entries = pdos[place] if place < len(pdos) else ()
            _map(connection, first + place, cob_id + 0x100 * place + config.node, entries, transmission)


def write(connection: CanConnection, entry: Object, value: int, shown: Object | None = None, mask: int = -1) -> None:
    """Write an object, read it or the one that shows it back; raises RigError where the drive holds another value."""
    connection.write(entry, value)
    held = connection.read(shown or entry)
    if (held ^ value) & mask:
        raise RigError(
            f"drive's {shown or entry} stayed {held} where {value} was written; "
            "close EPOS Studio and other programs, or change the value in the rig's file to one that the drive takes"
        )


def set_mode(connection: CanConnection, mode: int) -> None:
    """Set the mode of operation; raises RigError where the drive is not in it then."""
    write(connection, protocol.MODE, mode, shown=protocol.MODE_DISPLAY)


def _map(connection: CanConnection, number: int, cob_id: int, entries: tuple[Object, ...], transmission: int) -> None:
    """Mapping objects are 0x200 above those of the communication; a PDO must be off while its mapping changes."""

    def set_cob_id(value: int) -> None:
        entry = Object(number, 1, "I", "COB-ID")
        write(connection, entry, value | NO_REMOTE_REQUEST, mask=protocol.INVALID | 0x7FF)

    set_cob_id(cob_id | protocol.INVALID)
    if not entries:
        return
    count = Object(number + 0x200, 0, "B", "mapped objects")
    connection.write(count, 0)
    for place, entry in enumerate(entries, 1):
        write(connection, Object(number + 0x200, place, "I", "mapping"), entry.mapping)
    write(connection, count, len(entries))
    write(connection, Object(number, 2, "B", "transmission type"), transmission)
    set_cob_id(cob_id)
