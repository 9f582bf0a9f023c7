"""Object dictionary of an emulated EPOS2, and its process data (PDOs).

PDOs are initially disabled and empty. They are sent at every SYNC and applied immediately on
reception (transmission types 1 and 255).
"""

from collections.abc import Callable
from typing import Any

import canopen
from canopen import objectdictionary as od

from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.protocol import Object

PDOS = 4
"""Number of RPDOs, and of TPDOs, in an EPOS2."""
FIRST_TAKEN = 0x1400
FIRST_SENT = 0x1800
"""First communication objects of the RPDOs and of the TPDOs; the mapping object is 0x200 above
it."""
READ_ONLY_OBJECTS = frozenset(
    {
        protocol.DEVICE_TYPE,
        protocol.ERROR_REGISTER,
        protocol.STATUSWORD,
        protocol.MODE_DISPLAY,
        protocol.DEMAND,
        protocol.POSITION,
        protocol.VELOCITY,
        protocol.MOTOR_CURRENT,
        protocol.SUPPORTED_MODES,
        protocol.NEWEST_ERROR,
        protocol.SERIAL_NUMBER,
    }
)
_TYPES = {
    "b": od.INTEGER8,
    "h": od.INTEGER16,
    "i": od.INTEGER32,
    "B": od.UNSIGNED8,
    "H": od.UNSIGNED16,
    "I": od.UNSIGNED32,
}

OUT_OF_RANGE = 0x06090030
WRONG_STATE = 0x08000022
"""SDO abort codes for refused writes."""


def values(config: Epos2Config) -> dict[Object, int]:
    """Return the objects of a drive in factory state, set up for this motor and encoder but without
    our limits."""
    start = dict.fromkeys(protocol.OBJECTS, 0) | {
        # CiA 402: device profile 402 (0x0192), servo drive (0x0002).
        protocol.DEVICE_TYPE: 0x00020192,
        protocol.SYNC_ID: protocol.SYNC,
        protocol.SERIAL_NUMBER: 0x36020000 + config.node,
        # Not verified: no action on a lost heartbeat, and a brushless motor. A new drive may
        # differ.
        protocol.LOSS_REACTION: 0,
        protocol.FAULT_REACTION: 2,
        protocol.QUICK_STOP_OPTION: 6,
        protocol.MOTOR_TYPE: 10,
        protocol.ENCODER_LINES: config.encoder_lines,
        protocol.MODE: protocol.PROFILE_POSITION,
        protocol.POSITION_MIN: -(2**31),
        protocol.POSITION_MAX: 2**31 - 1,
        protocol.FOLLOWING_ERROR: 2000,
        protocol.FASTEST: 25000,
        protocol.PROFILE_VELOCITY: 1000,
        protocol.ACCELERATION: 10000,
        protocol.DECELERATION: 10000,
        protocol.QUICK_STOP_DECELERATION: 10000,
        # Not verified: an EPOS2 Module 36/2 supplies 2 A continuously and 4 A briefly.
        protocol.CONTINUOUS_CURRENT: 2000,
        protocol.CURRENT_LIMIT: 4000,
        # Homing and profile position: bits 5 and 0.
        protocol.SUPPORTED_MODES: 0x21,
    }
    for first, cob_id, transmission in (
        (FIRST_TAKEN, 0x200, protocol.AT_ONCE),
        (FIRST_SENT, 0x180, protocol.ON_SYNC),
    ):
        for number in range(first, first + PDOS):
            start |= {
                Object(number, 1, "I", "COB-ID"): protocol.INVALID
                | cob_id + 0x100 * (number - first) + config.node,
                Object(number, 2, "B", "transmission type"): transmission,
                Object(number + 0x200, 0, "B", "mapped objects"): 0,
            }
            start |= {Object(number + 0x200, entry + 1, "I", "mapping"): 0 for entry in range(8)}
    return start


def dictionary(start: dict[Object, int], read_only: frozenset[Object] = READ_ONLY_OBJECTS) -> Any:
    """Return canopen's object dictionary with the initial value of every object."""
    library: Any = od
    found = library.ObjectDictionary()
    records = {entry.number for entry in start if entry.sub}
    for number in records:
        found.add_object(library.ODRecord(f"0x{number:04X}", number))
    for entry, value in start.items():
        variable = library.ODVariable(str(entry), entry.number, entry.sub)
        variable.data_type = _TYPES[entry.form]
        variable.default = value
        variable.access_type = "ro" if entry in read_only else "rw"
        if entry.number in records:
            found[entry.number].add_member(variable)
        else:
            found.add_object(variable)
    return found


MappedObjects = dict[int, list[tuple[int, int, int]]]
"""Index, sub-index and length in bytes of the mapped objects, by COB-ID."""


class ProcessData:
    """PDOs of canopen's LocalNode `node`; `send(cob_id, data)` sends a frame."""

    def __init__(self, node: canopen.LocalNode, send: Callable[[int, bytes], None]) -> None:
        self._node = node
        self._send = send
        self.enabled: dict[int, MappedObjects] = {}
        """Cache of the enabled PDOs by first object; cleared when a PDO object is written."""

    def synchronise(self) -> None:
        """Send the TPDOs in response to a SYNC."""
        for cob_id, entries in self._enabled(FIRST_SENT).items():
            self._send(
                cob_id, b"".join(self._node.get_data(index, sub) for index, sub, _ in entries)
            )

    def take(self, cob_id: int, data: bytes) -> None:
        """Apply the RPDO in a frame; other frames have no effect."""
        entries = self._enabled(FIRST_TAKEN).get(cob_id, [])
        parts = []
        rest = data
        for index, sub, size in entries:
            parts.append((index, sub, rest[:size]))
            rest = rest[size:]
        # A frame is applied as a unit, so write the controlword after the values that it uses.
        for part in sorted(parts, key=lambda part: part[0] == protocol.CONTROLWORD.number):
            self._node.set_data(*part)

    def check(self, index: int, subindex: int) -> None:
        """Raise SdoAbortedError if a PDO object must not be written now."""
        self.enabled.clear()
        number = index & ~0x200
        if index != number:
            # CiA 301: the mapping may change only while the PDO is disabled, and entries only while
            # their count is 0.
            is_on = not self._value(number, 1, "I") & protocol.INVALID
            if is_on or (subindex and self._value(index, 0, "B")):
                raise canopen.SdoAbortedError(WRONG_STATE)

    def _enabled(self, first: int) -> MappedObjects:
        if first not in self.enabled:
            found = self.enabled[first] = {}
            for number in range(first, first + PDOS):
                cob_id = self._value(number, 1, "I")
                count = self._value(number + 0x200, 0, "B")
                if not cob_id & protocol.INVALID:
                    mapped = [self._value(number + 0x200, 1 + place, "I") for place in range(count)]
                    found[cob_id & 0x7FF] = [
                        (each >> 16, each >> 8 & 0xFF, (each & 0xFF) // 8) for each in mapped
                    ]
        return self.enabled[first]

    def _value(self, number: int, sub: int, form: str) -> int:
        layout = Object(number, sub, form, "").layout
        return int(layout.unpack(self._node.get_data(number, sub))[0])
