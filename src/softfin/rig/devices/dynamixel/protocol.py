"""Packets of Dynamixel Protocol 2.0 and the control table of the X series, without I/O.

Sources: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0" for packets and errors, "XM430-W350" for the
control table, and the pages on single entries (Bus Watchdog, Drive Mode, Homing Offset, Shutdown,
Indirect Data). Units and models are in `core.dynamixel`. The CRC is tested against packets printed
in the e-Manual. Nothing has been tested with a real servo yet. The e-Manual does not state the
following, so check it first: the torque stays on after the bus watchdog has tripped, position
limits apply to positions that include the homing offset, the indirect addresses may be written at
any time, and a restart resets them.

softfin does not use `dynamixel-sdk` from ROBOTIS. The SDK waits in busy loops on the real clock, so
it cannot run in simulated time, and it rejects an instruction, which could be a stop, while a
different thread waits for an answer. The tests use the SDK to read the emulated servo.
"""

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

PACKET_HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_PACKET_BYTES = 256
"""Maximum packet size that softfin accepts; larger sizes are garbled."""


class Instruction(IntEnum):
    """Instructions that softfin and its emulator support."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82


ALERT = 0x80
"""Bit in the error byte of a status packet: the hardware error status is not zero."""


class Refusal(IntEnum):
    """Error numbers of a status packet."""

    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Packet(NamedTuple):
    """A packet; for a status packet, the first byte of `data` is the error byte."""

    servo_id: int
    instruction: int
    data: bytes


def _crc_byte(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        # CRC-16 with the polynomial x^16 + x^15 + x^2 + 1, most significant bit first.
        crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


# A table, because the loop computes several CRCs at each tick.
_CRC_TABLE = tuple(map(_crc_byte, range(256)))


def crc16(data: bytes) -> int:
    """Return the CRC of a packet without its last two bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def encode_packet(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    body = bytes([packet.instruction]) + packet.data
    # Byte stuffing: the start of a header must not appear inside a packet.
    body = body.replace(PACKET_HEADER[:3], PACKET_HEADER[:3] + b"\xfd")
    start = PACKET_HEADER + struct.pack("<BH", packet.servo_id, len(body) + 2) + body
    return start + struct.pack("<H", crc16(start))


class PacketParser:
    """Finds packets in a byte stream that may be truncated, garbled or mixed with other data."""

    def __init__(self) -> None:
        self.crc_errors = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Packet]:
        """Return the packets completed by new bytes."""
        self._rest += data
        packets = []
        while (start := self._rest.find(PACKET_HEADER)) >= 0:
            packet = self._rest = self._rest[start:]
            if len(packet) < 7:
                break
            end = 7 + int.from_bytes(packet[5:7], "little")
            if not 10 <= end <= MAX_PACKET_BYTES:
                self._skip_header()
                continue
            if len(packet) < end:
                break
            if crc16(packet[: end - 2]) != int.from_bytes(packet[end - 2 : end], "little"):
                # Do not skip to the end of the packet, because its length may be garbled.
                self._skip_header()
                continue
            self._rest = packet[end:]
            body = packet[7 : end - 2].replace(PACKET_HEADER[:3] + b"\xfd", PACKET_HEADER[:3])
            packets.append(Packet(packet[4], body[0], body[1:]))
        self._rest = self._rest[-MAX_PACKET_BYTES:]
        return packets

    def _skip_header(self) -> None:
        self.crc_errors += 1
        self._rest = self._rest[1:]

    def clear(self) -> None:
        """Drop an incomplete packet."""
        self._rest = b""


class Entry(NamedTuple):
    """An entry of the control table."""

    address: int
    form: str
    """`struct` format character."""
    name: str

    @property
    def layout(self) -> struct.Struct:
        """Byte layout, little-endian."""
        return struct.Struct(f"<{self.form}")

    def __str__(self) -> str:
        return f"{self.name} ({self.address})"


MODEL_NUMBER = Entry(0, "H", "Model Number")
FIRMWARE_VERSION = Entry(6, "B", "Firmware Version")
SERVO_ID = Entry(7, "B", "ID")
DRIVE_MODE = Entry(10, "B", "Drive Mode")
OPERATING_MODE = Entry(11, "B", "Operating Mode")
HOMING_OFFSET = Entry(20, "i", "Homing Offset")
VELOCITY_LIMIT = Entry(44, "I", "Velocity Limit")
MAX_POSITION_LIMIT = Entry(48, "I", "Max Position Limit")
MIN_POSITION_LIMIT = Entry(52, "I", "Min Position Limit")
STARTUP_CONFIGURATION = Entry(60, "B", "Startup Configuration")
SHUTDOWN_ERRORS = Entry(63, "B", "Shutdown")
TORQUE_ENABLE = Entry(64, "B", "Torque Enable")
STATUS_RETURN_LEVEL = Entry(68, "B", "Status Return Level")
HARDWARE_ERROR = Entry(70, "B", "Hardware Error Status")
BUS_WATCHDOG = Entry(98, "B", "Bus Watchdog")
PROFILE_ACCELERATION = Entry(108, "I", "Profile Acceleration")
PROFILE_SPEED = Entry(112, "I", "Profile Velocity")
GOAL_POSITION = Entry(116, "i", "Goal Position")
REALTIME_TICK = Entry(120, "H", "Realtime Tick")
PRESENT_CURRENT = Entry(126, "h", "Present Current")
PRESENT_VELOCITY = Entry(128, "i", "Present Velocity")
PRESENT_POSITION = Entry(132, "i", "Present Position")
POSITION_TRAJECTORY = Entry(140, "i", "Position Trajectory")
PRESENT_INPUT_VOLTAGE = Entry(144, "H", "Present Input Voltage")
INDIRECT_ADDRESS = 168
INDIRECT_DATA = 224
"""Start of the 28 indirect addresses (two bytes each) and of the bytes that they select."""

EEPROM_END = 64
"""First address of the RAM. Entries below it survive a power loss and can be written only while the
torque is off."""

POSITION_MODE = 3
FIRST_FIRMWARE = 38
"""First firmware version with a bus watchdog. DynamixelSDK issue 584 reports a bug in unspecified
versions: with a homing offset, the servo moves when the bus watchdog trips."""
ALL_STATUS_PACKETS = 2
"""Status Return Level at which every instruction is answered."""
MAX_HOMING_OFFSET = 1024
"""In position mode, the servo ignores homing offsets of more than a quarter turn."""
ACCELERATION_UNIT_RPM_MIN = 214.577
"""Unit of acceleration [rev/min2]."""
TICK_UNIT_S = 1e-3
TICK_RANGE = 32_768
"""The realtime tick counts milliseconds and restarts at 0 after 32767."""
WATCHDOG_UNIT_S = 0.02
WATCHDOG_TRIPPED = 255
"""Value of Bus Watchdog (-1 as an unsigned byte) after no instruction arrived in time: the servo
has stopped and rejects new goals until 0 is written. The torque stays on."""


class HardwareError(IntFlag):
    """Bits of the hardware error status and of Shutdown."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    MOTOR_ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20


SHUTDOWN_DEFAULT = (
    HardwareError.OVERLOAD | HardwareError.ELECTRICAL_SHOCK | HardwareError.OVERHEATING
)
"""Errors at which the servo switches its torque off by factory default."""

FIXES = {
    HardwareError.INPUT_VOLTAGE: ("input voltage", "check the supply and its cable"),
    HardwareError.OVERHEATING: ("overheating", "let the servo cool down; move less or slower"),
    HardwareError.MOTOR_ENCODER: ("motor encoder", "restart the servo; replace it if this recurs"),
    HardwareError.ELECTRICAL_SHOCK: (
        "electrical shock",
        "check for a short circuit and a supply that is too weak",
    ),
    HardwareError.OVERLOAD: (
        "overload",
        "check for a blocked fin; reduce the velocity or the acceleration",
    ),
}


def error_line(status: int) -> str:
    """Return the names of the hardware errors and the fix for the first."""
    bits = [bit for bit in FIXES if status & bit]
    if not bits:
        return f"servo reports hardware error 0x{status:02X}; look it up in the e-Manual"
    names = ", ".join(FIXES[bit][0] for bit in bits)
    return f"servo reports hardware error 0x{status:02X}, {names}: {FIXES[bits[0]][1]}"


STATUS_ENTRIES = (
    TORQUE_ENABLE,
    HARDWARE_ERROR,
    BUS_WATCHDOG,
    GOAL_POSITION,
    REALTIME_TICK,
    PRESENT_CURRENT,
    PRESENT_VELOCITY,
    PRESENT_POSITION,
    POSITION_TRAJECTORY,
    PRESENT_INPUT_VOLTAGE,
)
"""Entries read at every tick; selected by indirect addresses, so that one read returns all of
them."""

STATUS_LAYOUT = struct.Struct("<" + "".join(entry.form for entry in STATUS_ENTRIES))

STATUS_ADDRESSES = tuple(
    entry.address + offset for entry in STATUS_ENTRIES for offset in range(entry.layout.size)
)
"""Address of each byte of a status."""


class Status(NamedTuple):
    """Values that the servo reports at every tick, in servo units."""

    torque: int
    hardware_error: int
    watchdog: int
    goal: int
    tick: int
    current: int
    velocity: int
    position: int
    trajectory: int
    voltage: int
