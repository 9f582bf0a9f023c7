"""The object dictionary of an emulated EPOS2, for canopen's LocalNode."""

from typing import Any

from canopen import ObjectDictionary
from canopen import objectdictionary as od

from softfin.rig.epos2 import objects
from softfin.rig.epos2.config import DriveConfig
from softfin.rig.epos2.objects import Object

PDOS = 4
"""Of each kind, as an EPOS2 has them."""
MAPPED = 8
"""Entries of a PDO at most."""
ERRORS_KEPT = 5
_IDENTITY = tuple(Object(0x1018, sub, "I", f"identity {sub}") for sub in range(1, 5))
"""Vendor, product, revision and serial number: every node has them (CiA 301)."""
MAXON = 0x000000FB
_TARGET_VELOCITY = Object(0x60FF, 0, "i", "target velocity")
_MAPPED_BY_DEFAULT = {
    0x1400: (0x200, objects.CONTROLWORD, (objects.MODE, objects.TARGET, _TARGET_VELOCITY)),
    0x1800: (0x180, objects.STATUSWORD, (objects.MODE_DISPLAY, objects.POSITION, objects.VELOCITY)),
}
"""First COB-ID, what each PDO carries, and what the second to fourth carry besides (CiA 402)."""

ENTRIES = "highest sub-index"

_TYPES = {
    "b": od.INTEGER8,
    "B": od.UNSIGNED8,
    "h": od.INTEGER16,
    "H": od.UNSIGNED16,
    "i": od.INTEGER32,
    "I": od.UNSIGNED32,
}
_READ_ONLY = frozenset(
    {
        objects.DEVICE_TYPE,
        objects.ERROR_REGISTER,
        objects.STATUSWORD,
        objects.MODE_DISPLAY,
        objects.DEMAND,
        objects.POSITION,
        objects.VELOCITY,
        objects.CURRENT,
        objects.SUPPORTED_MODES,
        *_IDENTITY,
    }
)


def values(config: DriveConfig) -> dict[Object, int]:
    """As the works and EPOS Studio leave a drive with this motor and encoder: our limits are not in it yet."""
    start: dict[Object, int] = dict.fromkeys(objects.OBJECTS, 0)
    start |= {
        objects.DEVICE_TYPE: 0x00020192,
        objects.ENCODER_LINES: config.encoder_lines,
        objects.MODE: objects.PROFILE_POSITION,
        objects.POSITION_MIN: -(2**31),
        objects.POSITION_MAX: 2**31 - 1,
        objects.FOLLOWING_ERROR: 2000,
        objects.FASTEST: 25000,
        objects.PROFILE_VELOCITY: 1000,
        objects.ACCELERATION: 10000,
        objects.DECELERATION: 10000,
        objects.QUICK_STOP_DECELERATION: 10000,
        objects.MOTOR_TYPE: 10,
        objects.CURRENT_LIMIT: 3000,
        # Homing, profile velocity and profile position: bits 5, 2 and 0.
        objects.SUPPORTED_MODES: 0x25,
        _TARGET_VELOCITY: 0,
        **dict.fromkeys(_IDENTITY, 0),
        _IDENTITY[0]: MAXON,
    }
    return start | _process_data(config.node) | {_error(place): 0 for place in range(2, ERRORS_KEPT + 1)}


def dictionary(start: dict[Object, int]) -> ObjectDictionary:
    """With every object at its value."""
    new: Any = ObjectDictionary
    made = new()
    make_record: Any = od.ODRecord
    groups: dict[int, list[Object]] = {}
    for each in start:
        groups.setdefault(each.number, []).append(each)
    for number, members in groups.items():
        if len(members) == 1 and members[0].sub == 0:
            made.add_object(_variable(members[0], start))
            continue
        record = make_record(members[0].name, number)
        if all(member.sub for member in members):
            count = Object(number, 0, "B", ENTRIES)
            record.add_member(_variable(count, {count: max(member.sub for member in members)}))
        for member in members:
            record.add_member(_variable(member, start))
        made.add_object(record)
    checked: ObjectDictionary = made
    return checked


def _variable(entry: Object, start: dict[Object, int]) -> Any:
    make: Any = od.ODVariable
    variable = make(str(entry), entry.number, entry.sub)
    variable.data_type = _TYPES[entry.form]
    is_error = entry.number == objects.NEWEST_ERROR.number and entry.sub > 0
    variable.access_type = "ro" if entry in _READ_ONLY or entry.name == ENTRIES or is_error else "rw"
    variable.default = start[entry]
    return variable


def _error(place: int) -> Object:
    return Object(objects.NEWEST_ERROR.number, place, "I", f"error {place}")


def _process_data(node: int) -> dict[Object, int]:
    start: dict[Object, int] = {}
    for first, (cob_id, word, others) in _MAPPED_BY_DEFAULT.items():
        for place in range(PDOS):
            number, mapped = first + place, [word, *others[place - 1 : place]] if place else [word]
            start |= {
                Object(number, 1, "I", f"COB-ID {number:X}"): cob_id + 0x100 * place + node,
                Object(number, 2, "B", f"transmission {number:X}"): objects.AT_ONCE,
                Object(number + 0x200, 0, "B", f"mapped objects {number:X}"): len(mapped),
            }
            for entry in range(MAPPED):
                held = mapped[entry].mapping if entry < len(mapped) else 0
                start[Object(number + 0x200, entry + 1, "I", f"mapping {number:X} {entry + 1}")] = held
    return start
