"""EPOS2 protocol: objects, process data, states, controlwords, and texts for faults and SDO aborts.

Indices, states and codes come from CiA 301 and 402 and from the maxon "EPOS2 Firmware
Specification" (rel5466), which we know only through drivers based on it; the suggested fixes are
ours. Not yet tested with a real drive: check the sub-indices of 0x2210 and 0x6410 and the home
position 0x2081 first.
"""

import struct
from enum import Enum, IntFlag
from typing import NamedTuple

BOOT_UP = 0x00
NODE_STOPPED = 0x04
OPERATIONAL = 0x05
"""Node states, as sent in the heartbeat."""

NMT_START = 0x01
NMT_STOP = 0x02
NMT_PRE_OPERATIONAL = 0x80
NMT_RESET = 0x81
NMT_RESET_COMMUNICATION = 0x82

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700
"""COB-IDs, to which the node number is added, except for NMT and the shared SYNC.

The SYNC of a host is 0x080 plus its node number. This is also the emergency COB-ID of the node,
which the host never uses.
"""
TPDO = (0x180, 0x280, 0x380)
RPDO = (0x200, 0x300)

PROFILE_POSITION = 1
HOMING = 6
HOME_HERE = 35
"""Homing method: the current position becomes home; nothing moves."""


class Object(NamedTuple):
    """One entry of the object dictionary of the drive."""

    number: int
    """Index in the dictionary; not named `index` because tuples have a method with this name."""
    sub: int
    form: str
    """`struct` format character: B, H, I for unsigned; b, h, i for signed."""
    name: str

    @property
    def layout(self) -> struct.Struct:
        """Byte layout: little-endian, as specified by CANopen."""
        return struct.Struct(f"<{self.form}")

    @property
    def mapping(self) -> int:
        """Mapping entry for this object in a PDO: index, sub-index and length in bits."""
        return self.number << 16 | self.sub << 8 | 8 * self.layout.size

    def __str__(self) -> str:
        return f"{self.name} (0x{self.number:04X}.{self.sub})"


DEVICE_TYPE = Object(0x1000, 0, "I", "device type")
ERROR_REGISTER = Object(0x1001, 0, "B", "error register")
ERROR_COUNT = Object(0x1003, 0, "B", "number of errors")
NEWEST_ERROR = Object(0x1003, 1, "I", "newest error")
SYNC_ID = Object(0x1005, 0, "I", "COB-ID of the SYNC")
HEARTBEAT_CONSUMER = Object(0x1016, 1, "I", "consumer heartbeat")
HEARTBEAT_PRODUCER = Object(0x1017, 0, "H", "producer heartbeat")
SERIAL_NUMBER = Object(0x1018, 4, "I", "serial number")
LOSS_BEHAVIOUR = Object(0x1029, 1, "B", "state after a communication error")
HOME_POSITION = Object(0x2081, 0, "i", "home position")
ENCODER_LINES = Object(0x2210, 1, "I", "encoder lines")
LOSS_REACTION = Object(0x6007, 0, "h", "abort connection option")
CONTROLWORD = Object(0x6040, 0, "H", "controlword")
STATUSWORD = Object(0x6041, 0, "H", "statusword")
QUICK_STOP_OPTION = Object(0x605A, 0, "h", "quick stop option")
FAULT_REACTION = Object(0x605E, 0, "h", "fault reaction option")
MODE = Object(0x6060, 0, "b", "mode of operation")
MODE_DISPLAY = Object(0x6061, 0, "b", "mode of operation display")
DEMAND = Object(0x6062, 0, "i", "position demand")
POSITION = Object(0x6064, 0, "i", "position")
FOLLOWING_ERROR = Object(0x6065, 0, "I", "largest following error")
VELOCITY = Object(0x606C, 0, "i", "velocity")
MOTOR_CURRENT = Object(0x6078, 0, "h", "current")
TARGET = Object(0x607A, 0, "i", "target position")
HOME_OFFSET = Object(0x607C, 0, "i", "home offset")
POSITION_MIN = Object(0x607D, 1, "i", "smallest position")
POSITION_MAX = Object(0x607D, 2, "i", "largest position")
FASTEST = Object(0x607F, 0, "I", "largest profile velocity")
PROFILE_VELOCITY = Object(0x6081, 0, "I", "profile velocity")
ACCELERATION = Object(0x6083, 0, "I", "profile acceleration")
DECELERATION = Object(0x6084, 0, "I", "profile deceleration")
QUICK_STOP_DECELERATION = Object(0x6085, 0, "I", "quick-stop deceleration")
PROFILE_TYPE = Object(0x6086, 0, "h", "profile type")
POSITION_NOTATION = Object(0x6089, 0, "b", "position notation index")
VELOCITY_NOTATION = Object(0x608B, 0, "b", "velocity notation index")
ACCELERATION_NOTATION = Object(0x608D, 0, "b", "acceleration notation index")
HOMING_METHOD = Object(0x6098, 0, "b", "homing method")
MOTOR_TYPE = Object(0x6402, 0, "H", "motor type")
CONTINUOUS_CURRENT = Object(0x6410, 1, "H", "continuous current limit")
CURRENT_LIMIT = Object(0x6410, 2, "H", "output current limit")
SUPPORTED_MODES = Object(0x6502, 0, "I", "supported modes")

REACTIONS = {LOSS_REACTION: 1, FAULT_REACTION: 2, QUICK_STOP_OPTION: 6}
"""Settings that stop the fin if softfin dies: a lost heartbeat is a fault, a fault causes braking
along the quick-stop ramp, and a quick stop brakes along the same ramp and then holds the position
(CiA 402).

Any of these settings may be stored in the drive as "no action". We have not verified that an EPOS2
has all three objects.
"""

# The objects are collected from this module so that the emulated drive has every object defined
# above.
OBJECTS = tuple(value for value in list(globals().values()) if isinstance(value, Object))

SENT = ((STATUSWORD, POSITION), (VELOCITY, MOTOR_CURRENT), (DEMAND,))
"""Objects that the drive sends after each SYNC: TPDO 1, 2, 3."""
TAKEN = ((CONTROLWORD, TARGET), (PROFILE_VELOCITY,))
"""Objects that the drive applies immediately: RPDO 1, 2."""
ON_SYNC = 1
AT_ONCE = 255
"""Transmission types of process data."""
INVALID = 1 << 31
"""Bit in the COB-ID of a PDO that disables the PDO."""


def host_cob_ids(host: int) -> frozenset[int]:
    """Return the COB-IDs reserved for one host: its heartbeat and its SYNC."""
    return frozenset({HEARTBEAT + host, SYNC + host})


def layout(objects: tuple[Object, ...]) -> struct.Struct:
    """Return the byte layout of a PDO containing these objects."""
    return struct.Struct("<" + "".join(each.form for each in objects))


SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
QUICK_STOP = 0x0002
DISABLE_VOLTAGE = 0x0000
FAULT_RESET = 0x0080
NEW_TARGET = 0x003F
"""Operation enabled, new target (bit 4), change immediately (bit 5), absolute (bit 6 is 0)."""
START_HOMING = 0x001F
RESET_EDGE = (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE)
"""Controlwords that acknowledge a fault: the drive needs a rising edge of bit 7, so it is cleared
first."""


class State(Enum):
    """The twelve states of an EPOS2; each value is the masked statusword.

    The generic masks of CiA 402, used in canopen's `State402`, would decode refresh and
    measure-init as "switched on".
    """

    START = 0x0000
    NOT_READY = 0x0100
    SWITCH_ON_DISABLED = 0x0140
    READY = 0x0121
    SWITCHED_ON = 0x0123
    REFRESH = 0x4123
    MEASURE_INIT = 0x4133
    OPERATION_ENABLED = 0x0137
    QUICK_STOP_ACTIVE = 0x0117
    FAULT_REACTION_DISABLED = 0x010F
    FAULT_REACTION_ENABLED = 0x011F
    FAULT = 0x0108


class Bit(IntFlag):
    """Bits of the statusword that are not part of the state."""

    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    LIMIT = 1 << 11
    ACKNOWLEDGED = 1 << 12
    """The new target was acknowledged; in homing mode: home attained."""
    ERROR = 1 << 13
    """Following error; in homing mode: homing error."""
    REFERENCED = 1 << 15


FAULT_STATES = frozenset({State.FAULT_REACTION_DISABLED, State.FAULT_REACTION_ENABLED, State.FAULT})
ENABLING = frozenset({State.REFRESH, State.MEASURE_INIT, State.OPERATION_ENABLED})
"""Operation enabled, and the two states through which a drive passes before it."""
POWERED = ENABLING | {State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ENABLED}
"""States in which the motor carries current."""
UNPOWERED = frozenset(State) - POWERED

TO_ENABLED: dict[State | None, int] = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}
"""Controlwords that bring a drive one step closer to operation enabled; in other states the drive
advances by itself.

A quick stop is always left by disabling the voltage, so that a stopped drive never resumes its
motion.
"""
_STATES = {state.value: state for state in State}


def describe_state(state: State | None, statusword: int) -> str:
    """Return the name of the state decoded from a statusword, for messages."""
    if state is None:
        return f"in an unknown state (statusword 0x{statusword:04X})"
    return state.name.lower().replace("_", " ")


def decode(statusword: int) -> State | None:
    """Return the state encoded in a statusword; None if it is not a state of an EPOS2."""
    # The mask keeps bits 0 to 6, 8 and 14, by which an EPOS2 distinguishes its states.
    return _STATES.get(statusword & 0x417F)


FAULTS = {
    0x1000: ("generic error", "switch the drive off and on"),
    0x2310: ("over-current", "check for a short circuit or a blocked fin; lower the acceleration"),
    0x3210: ("over-voltage", "check the supply; brake more gently, or add a brake resistor"),
    0x3220: ("under-voltage", "check the supply: its voltage fell below the minimum of the drive"),
    0x4210: ("over-temperature", "let the drive cool down; move less or more slowly"),
    0x5113: ("+5 V supply too low", "check for a short circuit in the encoder cable"),
    0x5114: ("supply of the output stage too low", "check the supply and its fuse"),
    0x6100: (
        "internal software error",
        "switch the drive off and on; update its firmware if the fault recurs",
    ),
    0x6320: (
        "software parameter error",
        "restore the defaults of the drive in EPOS Studio and tune it again",
    ),
    0x7320: (
        "position sensor error",
        "check the encoder and its cable; the encoder line count set in the drive must match the "
        "encoder",
    ),
    0x8110: ("CAN overrun, objects lost", "use fewer nodes or a higher bitrate on the bus"),
    0x8111: ("CAN overrun", "use fewer nodes or a higher bitrate on the bus"),
    0x8120: ("CAN error passive", "check the bus: termination, bitrate, cable"),
    0x8130: (
        "host heartbeat lost",
        "find out why the program hung or was killed; check the bus cable",
    ),
    0x8150: ("CAN message collision", "look for a second drive with the same node number"),
    0x81FD: ("CAN bus off", "check the bus: termination, bitrate, cable"),
    0x81FE: ("CAN receive queue overrun", "use fewer nodes or a higher bitrate on the bus"),
    0x81FF: ("CAN transmit queue overrun", "use fewer nodes or a higher bitrate on the bus"),
    0x8210: (
        "process data with wrong length",
        "look for another program that writes to the same drive",
    ),
    0x8611: (
        "following error",
        "check for a blocked fin; reduce velocity or acceleration, or tune the drive",
    ),
    0xFF01: ("hall sensor error", "check the hall sensor cable"),
    0xFF02: ("index processing error", "check the index channel of the encoder"),
    0xFF03: (
        "encoder resolution error",
        "set the encoder lines in the drive to match the encoder",
    ),
    0xFF04: ("hall sensor not found", "check the hall sensor cable"),
    0xFF06: ("negative limit switch", "turn the fin away from the switch"),
    0xFF07: ("positive limit switch", "turn the fin away from the switch"),
    0xFF08: (
        "hall angle detection error",
        "check the hall sensor cable and the number of pole pairs of the motor",
    ),
    0xFF09: ("software position limit", "turn the fin back inside its limits, or zero it again"),
    0xFF0A: ("position sensor breach", "check the encoder and its cable"),
    0xFF0B: ("system overloaded", "reduce the number of messages on the bus"),
}


HOST_LOST = 0x8130
NEEDS_RESET_OF_COMMUNICATION = frozenset({HOST_LOST, 0x8120, 0x81FD})
"""Communication faults that an EPOS4 clears only after an NMT reset communication, which does an
EPOS2 no harm."""


def fault_line(code: int) -> str:
    """Return the name of a fault and its fix, e.g. ``drive fault 0x8611, following error: check for
    a blocked fin; ..``."""
    name, way_out = FAULTS.get(
        code, ("unknown to softfin", "look it up in the EPOS2 Firmware Specification")
    )
    return f"drive fault 0x{code:04X}, {name}: {way_out}"


NO_OBJECT = 0x06020000
NO_SUB_INDEX = 0x06090011
READ_ONLY = 0x06010002
MISSING = frozenset({NO_OBJECT, NO_SUB_INDEX})
"""SDO abort codes for an object that the drive does not have."""

ABORTS = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "the drive timed out",
    0x05040001: "unknown command",
    0x06010000: "unsupported access to the object",
    0x06010001: "object is write-only",
    READ_ONLY: "object is read-only",
    NO_OBJECT: "object does not exist",
    0x06040041: "object cannot be mapped to process data",
    0x06040042: "process data would be too long",
    0x06060000: "hardware error",
    0x06070010: "wrong length of the value",
    NO_SUB_INDEX: "sub-index does not exist",
    0x06090030: "value outside its range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum below minimum",
    0x08000000: "general error",
    0x08000020: "value cannot be stored",
    0x08000022: "not allowed in the current state of the drive",
    0x0F00FFC0: "wrong NMT state",
    0x0F00FFBF: "illegal command",
    0x0F00FFBE: "wrong password",
    0x0F00FFBC: "not in service mode",
    0x0F00FFB9: "wrong node number",
}
"""Descriptions of SDO abort codes (CiA 301; the last five are specific to maxon)."""


def abort_line(code: int) -> str:
    """Return the name of an SDO abort and its fix, e.g. ``0x06020000, object does not exist: check
    that ..``."""
    name = ABORTS.get(code, "see the EPOS2 Communication Guide")
    way_out = (
        "check that the device is an EPOS2, close other programs such as EPOS Studio, and switch "
        "the drive off and on"
    )
    if 0x06090030 <= code <= 0x06090036:
        way_out = "use a value in the rig file that the drive accepts"
    return f"0x{code:08X}, {name}: {way_out}"


_ERROR_CLASSES = {
    0x001: "transmit time-outs",
    0x002: "lost arbitrations",
    0x008: "protocol violations",
    0x010: "transceiver errors",
    0x020: "frames without acknowledge",
    0x040: "bus-off",
    0x080: "bus errors",
    0x100: "controller restarts",
}
"""Error classes in the identifier of an error frame (linux/can/error.h)."""
_CONTROLLER_CLASS = 0x004
_CONTROLLER_STATES = {
    0x01: "receive overflows",
    0x02: "transmit overflows",
    0x04: "error warnings",
    0x08: "error warnings",
    0x10: "error passive",
    0x20: "error passive",
}
"""Controller states in byte 1 of an error frame of the controller class."""
BUS_FAILURES = frozenset({"error passive", "bus-off"})
"""Errors after which the adapter is unreliable, so frames (including a stop) may not reach the
drive."""


def bus_errors(classes: int, data: bytes) -> list[str]:
    """Return the names of the errors in a SocketCAN error frame, sorted and without duplicates."""
    names = {name for bit, name in _ERROR_CLASSES.items() if classes & bit}
    if classes & _CONTROLLER_CLASS and len(data) > 1:
        names |= {name for bit, name in _CONTROLLER_STATES.items() if data[1] & bit}
    return sorted(names) or ["error frames"]
