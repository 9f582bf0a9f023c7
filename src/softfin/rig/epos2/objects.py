"""The objects of an EPOS2 that softfin reads and writes, and how they are laid into process data (PDO).

Indices: maxon "EPOS2 Firmware Specification" (rel5466), by way of drivers written from it. Not met by a real drive yet;
the sub-indices of 0x2210 and 0x6410 and the home position 0x2081 are the ones to look at first.
"""

import struct
from typing import NamedTuple

BOOT_UP, OPERATIONAL = 0x00, 0x05
"""States of a node in its heartbeat."""

NMT_START, NMT_PRE_OPERATIONAL, NMT_RESET = 0x01, 0x80, 0x81

NMT, SYNC, EMERGENCY, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x080, 0x580, 0x600, 0x700
"""COB-IDs; to all but NMT and SYNC the node's number is added."""
TPDO = (0x180, 0x280, 0x380)
RPDO = (0x200, 0x300)

PROFILE_POSITION, HOMING = 1, 6
HOME_HERE = 35
"""Homing method: the present position is home; nothing moves."""
BRUSHLESS = {10: "sinusoidal brushless", 11: "block brushless"}
SERVO_DRIVE = 402
"""Low word of the device type."""


class Object(NamedTuple):
    """One entry of the drive's object dictionary."""

    number: int
    """Index in the dictionary; a tuple has a method of that name."""
    sub: int
    form: str
    """Letter of its type in `struct`: B, H, I unsigned; b, h, i signed."""
    name: str

    @property
    def layout(self) -> struct.Struct:
        """Layout of its bytes: little-endian, as CANopen has it."""
        return struct.Struct(f"<{self.form}")

    @property
    def mapping(self) -> int:
        """Entry that stands for it in a PDO's mapping."""
        return self.number << 16 | self.sub << 8 | 8 * self.layout.size

    def __str__(self) -> str:
        return f"{self.name} (0x{self.number:04X}.{self.sub})"


DEVICE_TYPE = Object(0x1000, 0, "I", "device type")
ERROR_REGISTER = Object(0x1001, 0, "B", "error register")
ERROR_COUNT = Object(0x1003, 0, "B", "number of errors")
NEWEST_ERROR = Object(0x1003, 1, "I", "newest error")
HEARTBEAT_CONSUMER = Object(0x1016, 1, "I", "consumer heartbeat")
HEARTBEAT_PRODUCER = Object(0x1017, 0, "H", "producer heartbeat")
HOME_POSITION = Object(0x2081, 0, "i", "home position")
ENCODER_LINES = Object(0x2210, 1, "I", "encoder lines")
CONTROLWORD = Object(0x6040, 0, "H", "controlword")
STATUSWORD = Object(0x6041, 0, "H", "statusword")
MODE = Object(0x6060, 0, "b", "mode of operation")
MODE_DISPLAY = Object(0x6061, 0, "b", "mode of operation display")
DEMAND = Object(0x6062, 0, "i", "position demand")
POSITION = Object(0x6064, 0, "i", "position")
FOLLOWING_ERROR = Object(0x6065, 0, "I", "largest following error")
VELOCITY = Object(0x606C, 0, "i", "velocity")
CURRENT = Object(0x6078, 0, "h", "current")
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
HOMING_METHOD = Object(0x6098, 0, "b", "homing method")
MOTOR_TYPE = Object(0x6402, 0, "H", "motor type")
CURRENT_LIMIT = Object(0x6410, 2, "H", "output current limit")
SUPPORTED_MODES = Object(0x6502, 0, "I", "supported modes")

OBJECTS = tuple(value for value in list(globals().values()) if isinstance(value, Object))

SENT = ((STATUSWORD, POSITION), (VELOCITY, CURRENT), (DEMAND,))
"""Objects that the drive sends on every SYNC: TPDO 1, 2, 3."""
TAKEN = ((CONTROLWORD, TARGET), (PROFILE_VELOCITY,))
"""Objects that the drive takes at once: RPDO 1, 2."""
ON_SYNC, AT_ONCE = 1, 255
"""Transmission types of process data."""
INVALID = 1 << 31
"""Bit of a PDO's COB-ID: it is off."""


def layout(objects: tuple[Object, ...]) -> struct.Struct:
    """Layout of a PDO that carries these objects."""
    return struct.Struct("<" + "".join(each.form for each in objects))
