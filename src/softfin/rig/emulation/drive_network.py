"""The emulated drive's end of the bus: canopen's network, what a node has to refuse, and a cable that can be cut."""

from collections import Counter
from collections.abc import Callable

import can
import canopen

from softfin.rig import epos2_objects as objects

SDO_LENGTH = 8
NMT_STOP, NMT_RESET_COMMUNICATION = 0x02, 0x82
NMT_COMMANDS = (
    objects.NMT_START,
    NMT_STOP,
    objects.NMT_PRE_OPERATIONAL,
    objects.NMT_RESET,
    NMT_RESET_COMMUNICATION,
)


class DriveNetwork(canopen.Network):
    """`take(cob_id, data)` gets each frame after canopen, `request(cob_id)` each remote frame; no frame can end it."""

    def __init__(
        self, take: Callable[[int, bytes], None], request: Callable[[int], None], state: Callable[[], str]
    ) -> None:
        """`state` is the node's NMT state as canopen calls it."""
        super().__init__()
        self._take, self._request, self._state = take, request, state
        self.counters: Counter[str] = Counter()
        self.listeners = [_Listener(self)]  # type: ignore[list-item]
        self.silent = False

    def send_message(self, can_id: int, data: bytes | bytearray | list[int], remote: bool = False) -> None:
        """Nothing leaves over a cut cable."""
        if not self.silent and self.bus is not None:
            super().send_message(can_id, bytes(data), remote)

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """One frame has come."""
        if self.silent or not self._is_taken(can_id, data):
            return
        try:
            super().notify(can_id, data, timestamp)
            self._take(can_id, bytes(data))
        except Exception:
            # Whatever canopen makes of a frame that makes no sense.
            self.counters["refused frames"] += 1

    def request(self, can_id: int) -> None:
        """A remote frame has come."""
        if not self.silent:
            self._request(can_id)

    def _is_taken(self, can_id: int, data: bytearray) -> bool:
        is_sdo = can_id & 0x780 == objects.SDO_REQUEST
        if is_sdo and self._state() == "STOPPED":
            return False
        # canopen's server would print a traceback for the first, and has states of its own for the second.
        wrong_sdo = is_sdo and len(data) != SDO_LENGTH
        wrong_nmt = can_id == objects.NMT and (len(data) != 2 or data[0] not in NMT_COMMANDS)
        self.counters["refused frames"] += wrong_sdo or wrong_nmt
        return not (wrong_sdo or wrong_nmt)


class _Listener(can.Listener):
    """canopen's own takes 29-bit identifiers for 11-bit ones, and leaves remote frames out."""

    def __init__(self, network: DriveNetwork) -> None:
        self._network = network

    def on_message_received(self, msg: can.Message) -> None:
        if msg.is_error_frame or msg.is_extended_id:
            return
        if msg.is_remote_frame:
            self._network.request(msg.arbitration_id)
        else:
            self._network.notify(msg.arbitration_id, msg.data, msg.timestamp)
