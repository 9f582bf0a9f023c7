"""The process data (PDO) of an emulated EPOS2: when they are sent and taken, and how they may be mapped (CiA 301).

Transmission types: 0 at the SYNC after a change, n = 1 to 240 at every n-th SYNC, 252 and 253 on request (a remote
frame) alone, 254 and 255 as soon as something changes. Process data that are taken act at the next SYNC (up to 240) or
at once (254, 255).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import canopen

from softfin.rig.emulation.drive_dictionary import MAPPED, PDOS
from softfin.rig.epos2 import objects
from softfin.rig.epos2.objects import Object

CANNOT_BE_MAPPED, TOO_LONG, OUT_OF_RANGE, WRONG_STATE = 0x06040041, 0x06040042, 0x06090030, 0x08000022
"""Why a write is refused (SDO abort codes)."""
LENGTH_ERROR = 0x8210
"""Emergency: a frame is shorter than what is mapped."""
NO_REMOTE_REQUEST, LONG_IDENTIFIER = 1 << 30, 1 << 29
"""Bits of a PDO's COB-ID."""
ACYCLIC, LAST_SYNCHRONOUS, SAMPLED_ON_SYNC, FIRST_EVENT = 0, 240, 252, 254
LONGEST_BITS = 64
_TAKEN, _SENT = 0x1400, 0x1800
_FREE = (range(0x181, 0x580), range(0x680, 0x6E0))
"""COB-IDs that CiA 301 leaves to process data."""


class _Pdo(NamedTuple):
    number: int
    """Index of its communication object."""
    cob_id: int
    """With its bits."""
    transmission: int
    entries: list[tuple[int, int, int]]
    """Index, sub-index and bits of what is mapped."""


class ProcessData:
    """Of canopen's LocalNode `node`; `send(cob_id, data)` puts a frame on the bus, `fault(code)` is the drive's."""

    def __init__(self, node: Any, send: Callable[[int, bytes], None], fault: Callable[[int], None]) -> None:
        self._node, self._send, self._fault = node, send, fault
        self.restart()

    def restart(self) -> None:
        """Nothing is counted, sent or pending: as the node is when it becomes operational."""
        self._known: dict[int, _Pdo] = {}
        """As set up, until one of their objects is written."""
        self._syncs = 0
        self._last: dict[int, bytes] = {}
        """What was sent last."""
        self._sampled: dict[int, bytes] = {}
        """At the last SYNC, for requests."""
        self._pending: dict[int, bytes] = {}
        """Taken, to act at the next SYNC."""

    def synchronise(self) -> None:
        """A SYNC has come."""
        self._syncs += 1
        for pdo in self._enabled(_SENT):
            if pdo.transmission == ACYCLIC:
                self._send_changed(pdo)
            elif pdo.transmission <= LAST_SYNCHRONOUS:
                if self._syncs % pdo.transmission == 0:
                    self._transmit(pdo, self._data(pdo))
            elif pdo.transmission == SAMPLED_ON_SYNC:
                self._sampled[pdo.number] = self._data(pdo)
        pending, self._pending = self._pending, {}
        for pdo in self._enabled(_TAKEN):
            if pdo.number in pending:
                self._apply(pdo, pending[pdo.number])

    def send_events(self) -> None:
        """Send what has changed, where it is to be sent at once."""
        for pdo in self._enabled(_SENT):
            if pdo.transmission >= FIRST_EVENT:
                self._send_changed(pdo)

    def request(self, cob_id: int) -> None:
        """A remote frame has come."""
        for pdo in self._enabled(_SENT):
            if pdo.cob_id & 0x7FF == cob_id and not pdo.cob_id & NO_REMOTE_REQUEST:
                sampled = self._sampled.get(pdo.number) if pdo.transmission == SAMPLED_ON_SYNC else None
                self._transmit(pdo, self._data(pdo) if sampled is None else sampled)

    def take(self, cob_id: int, data: bytes) -> None:
        """A frame has come; others than process data are left alone."""
        for pdo in self._enabled(_TAKEN):
            if pdo.cob_id & 0x7FF != cob_id:
                continue
            if 8 * len(data) < sum(bits for _, _, bits in pdo.entries):
                self._fault(LENGTH_ERROR)
            elif pdo.transmission <= LAST_SYNCHRONOUS:
                self._pending[pdo.number] = data
            else:
                self._apply(pdo, data)

    def check(self, index: int, subindex: int, data: bytes | bytearray) -> None:
        """Whether this may be written into an object of process data now; raises SdoAbortedError."""
        self._known.clear()
        value, number = int.from_bytes(data, "little"), index & ~0x200
        held = self._value(number, 1, "I")
        if index != number:
            if not held & objects.INVALID or self._node.nmt.state == "OPERATIONAL":
                raise canopen.SdoAbortedError(WRONG_STATE)
            self._check_mapping(index, subindex, value)
        elif subindex == 1 and not value & objects.INVALID:
            if value & LONG_IDENTIFIER or not any(value & 0x7FF in free for free in _FREE):
                raise canopen.SdoAbortedError(OUT_OF_RANGE)
            if not held & objects.INVALID and (value ^ held) & 0x7FF:
                raise canopen.SdoAbortedError(WRONG_STATE)
        elif subindex == 2:
            reserved = range(LAST_SYNCHRONOUS + 1, SAMPLED_ON_SYNC if number >= _SENT else FIRST_EVENT)
            if value in reserved:
                raise canopen.SdoAbortedError(OUT_OF_RANGE)

    def _check_mapping(self, index: int, subindex: int, value: int) -> None:
        if subindex:
            if self._value(index, 0, "B"):
                raise canopen.SdoAbortedError(WRONG_STATE)
            # An entry that is emptied is looked at when it is counted.
            entries = [value] if value else []
        elif value > MAPPED:
            raise canopen.SdoAbortedError(TOO_LONG)
        else:
            entries = [self._value(index, 1 + place, "I") for place in range(value)]
        for entry in entries:
            self._check_entry(entry, sent=index >= _SENT)
        if sum(entry & 0xFF for entry in entries) > LONGEST_BITS:
            raise canopen.SdoAbortedError(TOO_LONG)

    def _check_entry(self, entry: int, sent: bool) -> None:
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        found = self._node.object_dictionary.get_variable(index, subindex) if index >= 0x2000 else None
        if (
            found is None
            or (found.subindex, len(found)) != (subindex, bits)
            or not (found.readable if sent else found.writable)
        ):
            raise canopen.SdoAbortedError(CANNOT_BE_MAPPED)

    def _enabled(self, first: int) -> list[_Pdo]:
        numbers = range(first, first + PDOS)
        if first not in self._known:
            self._known |= {number: self._pdo(number) for number in numbers}
        return [pdo for number in numbers if not (pdo := self._known[number]).cob_id & objects.INVALID]

    def _pdo(self, number: int) -> _Pdo:
        cob_id, transmission = self._value(number, 1, "I"), self._value(number, 2, "B")
        mapping = number + 0x200
        entries = [self._value(mapping, 1 + place, "I") for place in range(self._value(mapping, 0, "B"))]
        return _Pdo(number, cob_id, transmission, [(each >> 16, each >> 8 & 0xFF, each & 0xFF) for each in entries])

    def _value(self, number: int, sub: int, form: str) -> int:
        value: int = Object(number, sub, form, "").layout.unpack(self._node.get_data(number, sub))[0]
        return value

    def _data(self, pdo: _Pdo) -> bytes:
        return b"".join(self._node.get_data(index, sub) for index, sub, _ in pdo.entries)

    def _send_changed(self, pdo: _Pdo) -> None:
        data = self._data(pdo)
        if data != self._last.get(pdo.number):
            self._transmit(pdo, data)

    def _transmit(self, pdo: _Pdo, data: bytes) -> None:
        self._last[pdo.number] = data
        self._send(pdo.cob_id & 0x7FF, data)

    def _apply(self, pdo: _Pdo, data: bytes) -> None:
        parts = []
        for index, sub, bits in pdo.entries:
            parts.append((index, sub, data[: bits // 8]))
            data = data[bits // 8 :]
        # One frame holds at one moment: what it orders comes after what it sets.
        for part in sorted(parts, key=lambda part: part[0] == objects.CONTROLWORD.number):
            self._node.set_data(*part)
