"""Before an EPOS2 may move: is it the one of the rig's file, does it hold our limits? All is written and read back.

Nothing here moves the motor, and nothing is stored for good: the drive forgets it at power-down.
"""

from softfin.core.errors import DeviceError, RigError
from softfin.rig.epos2 import cia402, objects
from softfin.rig.epos2.config import DriveConfig, Units
from softfin.rig.epos2.faults import fault_line
from softfin.rig.epos2.objects import Object
from softfin.rig.epos2.wire import Wire

NO_REMOTE_REQUEST = 1 << 30
HEARTBEATS = 10
"""The drive's in the time after which silence means that it is gone."""
HOME = {objects.HOMING_METHOD: objects.HOME_HERE, objects.HOME_OFFSET: 0, objects.HOME_POSITION: 0}
"""What makes the present position zero."""
COB_ID_MASK = objects.INVALID | 0x7FF


def milliseconds(seconds: float) -> int:
    """As the heartbeat objects hold times; at least 1."""
    return max(1, round(1000 * seconds))


def identify(wire: Wire, config: DriveConfig) -> None:
    """Raises RigError where the node is not there, and says which are; or where it is no drive."""
    try:
        device = wire.ask(objects.DEVICE_TYPE)
    except DeviceError:
        others = [node for node in wire.scan() if node != config.node]
        found = f"node{'s' * (len(others) > 1)} {', '.join(map(str, others))} did: set drive.node" if others else ""
        raise RigError(
            f"no drive answers as node {config.node} on {wire.name}; "
            + (found or "no other node does either: look at supply, cable, termination and bus.bitrate")
        ) from None
    if device & 0xFFFF != objects.SERVO_DRIVE:
        raise RigError(
            f"node {config.node} is no drive: its device type is 0x{device:08X}, not CiA {objects.SERVO_DRIVE}; "
            "set drive.node of the rig's file to the EPOS2's"
        )


def fault_of(wire: Wire) -> str:
    """Name of the drive's newest error."""
    if wire.ask(objects.ERROR_COUNT):
        return fault_line(wire.ask(objects.NEWEST_ERROR) & 0xFFFF)
    return "drive is in fault without an entry in its error history"


def refuse_busy(wire: Wire) -> None:
    """Raises RigError for a drive in fault, or one that somebody else has enabled."""
    word = wire.ask(objects.STATUSWORD)
    state = cia402.decode(word)
    if state in cia402.FAULTS:
        raise RigError(f"{fault_of(wire)}; then run: softfin rig check --reset-fault")
    if state is None:
        raise RigError(f"drive's statusword 0x{word:04X} is none of an EPOS2; check drive.node of the rig's file")
    if state in cia402.POWERED:
        raise RigError(
            f"drive is in state {state.words} already; close the program that drives it, or switch it off and on"
        )


def check(wire: Wire, config: DriveConfig) -> None:
    """Motor, modes and encoder as the drive is set up, against the rig's file; raises RigError."""
    motor = wire.ask(objects.MOTOR_TYPE)
    if motor not in objects.BRUSHLESS:
        known = " or ".join(f"{number} ({name})" for number, name in objects.BRUSHLESS.items())
        raise RigError(f"drive's motor type is {motor}; an EC-max has {known}: set the motor up in EPOS Studio")
    if not wire.ask(objects.SUPPORTED_MODES) & 1 << objects.PROFILE_POSITION - 1:
        raise RigError("drive has no profile position mode; update its firmware")
    lines = wire.ask(objects.ENCODER_LINES)
    if lines != config.encoder_lines:
        raise RigError(
            f"drive is set to an encoder of {lines} lines, the rig's file says encoder_lines {config.encoder_lines}; "
            "correct whichever is wrong, or every angle is"
        )


def configure(wire: Wire, config: DriveConfig) -> None:
    """Limits, profile, mode, heartbeat and process data; the node must be pre-operational."""
    for entry, value in limits(config).items():
        write(wire, entry, value)
    set_mode(wire, objects.PROFILE_POSITION)
    write(wire, objects.HEARTBEAT_PRODUCER, milliseconds(config.heartbeat_s / HEARTBEATS))
    for number, entries in enumerate(objects.SENT):
        _map(wire, 0x1800 + number, objects.TPDO[number] + config.node, entries, objects.ON_SYNC)
    for number, entries in enumerate(objects.TAKEN):
        _map(wire, 0x1400 + number, objects.RPDO[number] + config.node, entries, objects.AT_ONCE)
    # What else the drive was once told to send and take: TPDO 4, RPDO 3 and 4.
    for unused, cob_id in ((0x1803, 0x480), (0x1402, 0x400), (0x1403, 0x500)):
        _set_cob_id(wire, unused, cob_id + config.node | objects.INVALID)


def limits(config: DriveConfig) -> dict[Object, int]:
    """What the drive itself is to keep to."""
    units = Units.of(config)
    ends = sorted((units.counts(config.angle_min_rad), units.counts(config.angle_max_rad)))
    values = {
        objects.HEARTBEAT_CONSUMER: 0,
        objects.POSITION_MIN: ends[0],
        objects.POSITION_MAX: ends[1],
        objects.FOLLOWING_ERROR: units.distance(config.following_error_rad),
        objects.FASTEST: units.rpm(config.fastest_rad_s),
        objects.PROFILE_VELOCITY: units.rpm(config.slowest_rad_s),
        objects.ACCELERATION: units.rpm_s(config.acceleration_rad_s2),
        objects.DECELERATION: units.rpm_s(config.acceleration_rad_s2),
        objects.QUICK_STOP_DECELERATION: units.rpm_s(config.quick_stop_rad_s2),
        objects.PROFILE_TYPE: 0,
    }
    if config.current_limit_a is not None:
        values[objects.CURRENT_LIMIT] = round(1000 * config.current_limit_a)
    return values


def write(wire: Wire, entry: Object, value: int) -> None:
    """Write and read back; raises RigError where the drive holds another value."""
    wire.tell(entry, value)
    _same(entry, value, wire.ask(entry))


def set_mode(wire: Wire, mode: int) -> None:
    """And see that the drive is in it."""
    wire.tell(objects.MODE, mode)
    _same(objects.MODE_DISPLAY, mode, wire.ask(objects.MODE_DISPLAY))


def _map(wire: Wire, number: int, cob_id: int, entries: tuple[Object, ...], transmission: int) -> None:
    """Mapping objects are 0x200 above those of the communication; a PDO must be off while its mapping changes."""
    _set_cob_id(wire, number, cob_id | objects.INVALID)
    count = Object(number + 0x200, 0, "B", "mapped objects")
    wire.tell(count, 0)
    for place, entry in enumerate(entries, 1):
        write(wire, Object(number + 0x200, place, "I", "mapping"), entry.mapping)
    write(wire, count, len(entries))
    write(wire, Object(number, 2, "B", "transmission type"), transmission)
    _set_cob_id(wire, number, cob_id)


def _set_cob_id(wire: Wire, number: int, cob_id: int) -> None:
    entry = Object(number, 1, "I", "COB-ID")
    wire.tell(entry, cob_id | NO_REMOTE_REQUEST)
    _same(entry, cob_id & COB_ID_MASK, wire.ask(entry) & COB_ID_MASK)


def _same(entry: Object, wanted: int, held: int) -> None:
    if held != wanted:
        raise RigError(
            f"drive's {entry} stayed {held} where {wanted} was written; "
            "close EPOS Studio and other programs, or change the value in the rig's file to one that the drive takes"
        )
