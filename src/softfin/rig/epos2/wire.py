"""The wire to the drive: a python-can bus with its receiving thread, and canopen's SDO client on it; bounded in time.

Frames come in through one callback, in the receiver's thread. canopen's own `Network` is not used: a malformed frame or
one receiving error ends its thread, and every later frame, a quick stop too, then raises.
"""

import contextlib
import logging
import queue
import socket
import struct
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import can
from canopen import ObjectDictionary, SdoAbortedError, SdoCommunicationError
from canopen.sdo.client import SdoClient

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError
from softfin.rig.epos2 import objects
from softfin.rig.epos2.config import BusConfig
from softfin.rig.epos2.faults import abort_line
from softfin.rig.epos2.objects import Object
from softfin.rig.simulated_bus import open_bus

SDO_TIMEOUT_S = 0.5
SEND_TIMEOUT_S = 0.05
RECEIVER_CYCLE_S = 0.05
CLOSE_TIMEOUT_S = 0.5
ERROR_PAUSE_S = 0.05
"""After a receiving error, so that a bus that is gone does not take a whole core."""
SCAN_PAUSE_S = 0.002
"""Between two questions: the transmit queue of a SocketCAN interface holds ten frames."""

for _library in ("can", "canopen"):
    # What they would say on the terminal is said by our errors.
    logging.getLogger(_library).addHandler(logging.NullHandler())


class Wire:
    """To one node; `take(cob_id, data)` and `trouble(line)` are called from the receiver's thread."""

    def __init__(
        self,
        config: BusConfig,
        node: int,
        take: Callable[[int, bytes], None],
        trouble: Callable[[str], None],
        clock: Clock = REAL,
    ) -> None:
        self._config, self._node, self._take, self._trouble, self._clock = config, node, take, trouble, clock
        self._bus: can.BusABC | None = None
        self._receiving: threading.Thread | None = None
        # Re-entrant, for a stop in a signal handler that interrupts a send.
        self._sending, self._asking = clock.lock(), clock.lock()
        self._asks = False
        """Whether an answer is waited for."""
        client: Any = _Client
        dictionary: Any = ObjectDictionary
        self._sdo = client(objects.SDO_REQUEST + node, objects.SDO_ANSWER + node, dictionary(), clock)
        self._sdo.network = self
        self._receiver: int | None = None
        self.heard: set[int] = set()
        """Nodes that sent anything."""
        self.counters: Counter[str] = Counter()

    @property
    def name(self) -> str:
        """Of the bus, for messages."""
        return f"CAN bus {self._config.interface} {self._config.channel}"

    @property
    def in_receiver(self) -> bool:
        """Whether this is the receiver's thread, which must not wait for an answer."""
        return threading.get_ident() == self._receiver

    def open(self) -> None:
        """Raises RigError where there is no such bus."""
        self.heard.clear()
        # Of the bus before: another thread may have its number by now.
        self._receiver = None
        options = self._config.options
        try:
            if self._config.interface == "socketcand":
                # python-can would try for ten seconds, and fill the terminal.
                address = (str(options.get("host", "127.0.0.1")), int(options.get("port", 29536)))
                socket.create_connection(address, timeout=2).close()
            bus = self._bus = open_bus(self._config, self._clock)
            self._receiving = self._clock.spawn(lambda: self._receive(bus), "drive receiver")
        except Exception as error:
            # Every interface of python-can has errors of its own.
            self.close()
            raise RigError(
                f"{self.name} cannot be opened ({_one_line(error)}); check bus.interface, bus.channel and bus.options "
                "of the rig's file, and that the adapter is plugged in and up"
            ) from None

    def close(self) -> None:
        """Any number of times; never raises."""
        receiving, bus, self._receiving, self._bus = self._receiving, self._bus, None, None
        if receiving is not None and not self.in_receiver:
            receiving.join(CLOSE_TIMEOUT_S)
        if bus is not None:
            with contextlib.suppress(Exception):
                bus.shutdown()

    def send(self, cob_id: int, data: bytes) -> None:
        """One frame; raises DeviceError where the bus does not take it."""
        bus = self._bus
        if bus is None:
            raise DeviceError(f"{self.name} is closed; open the drive first")
        if not self._sending.acquire(timeout=2 * SEND_TIMEOUT_S):
            raise DeviceError(f"{self.name} takes no frames; look at the adapter and its cable")
        try:
            bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False), SEND_TIMEOUT_S)
        except Exception as error:
            raise DeviceError(
                f"{self.name} takes no frames ({_one_line(error)}); look at the adapter, cable, termination and bitrate"
            ) from None
        finally:
            self._sending.release()

    def send_message(self, cob_id: int, data: bytes | bytearray, remote: bool = False) -> None:
        """What canopen's SDO client calls; it asks for no remote frames."""
        self.send(cob_id, bytes(data))

    def ask(self, entry: Object) -> int:
        """The value of an object; raises DeviceError."""
        data = self._exchange(entry, lambda: self._sdo.upload(entry.number, entry.sub))
        try:
            value: int = entry.layout.unpack(data or b"")[0]
        except (struct.error, TypeError):
            raise DeviceError(f"drive's {entry}: answered {data!r}, not {entry.layout.size} bytes") from None
        return value

    def tell(self, entry: Object, value: int) -> None:
        """Write an object; raises DeviceError."""
        self._exchange(entry, lambda: self._sdo.download(entry.number, entry.sub, entry.layout.pack(value)))

    def shout(self, entry: Object, value: int) -> None:
        """Write an object without waiting for the answer; raises DeviceError where the bus takes no frame."""
        unused = 4 - entry.layout.size
        head = struct.pack("<BHB", 0x23 | unused << 2, entry.number, entry.sub)
        self.send(objects.SDO_REQUEST + self._node, head + entry.layout.pack(value) + bytes(unused))

    def scan(self) -> list[int]:
        """Ask every node for its device type, so that all that are on the bus are `heard`."""
        for node in range(1, 128):
            self.send(objects.SDO_REQUEST + node, struct.pack("<BHBI", 0x40, objects.DEVICE_TYPE.number, 0, 0))
            self._clock.sleep(SCAN_PAUSE_S)
        self._clock.sleep(50 * SCAN_PAUSE_S)
        return sorted(self.heard)

    def _exchange(self, entry: Object, action: Callable[[], bytes | None]) -> bytes | None:
        if self.in_receiver or not self._asking.acquire(timeout=2 * SDO_TIMEOUT_S):
            raise DeviceError(f"drive's {entry} cannot be asked for: another question is not answered yet; try again")
        try:
            self._asks = True
            return action()
        except SdoAbortedError as error:
            raise DeviceError(f"drive refuses {entry}: {abort_line(error.code)}") from None
        except SdoCommunicationError:
            raise DeviceError(
                f"drive {self._node} does not answer for {entry} within {SDO_TIMEOUT_S:g} s; "
                "look at its supply, the bus's cable and its bitrate"
            ) from None
        except (struct.error, ValueError, OSError, RuntimeError) as error:
            raise DeviceError(f"drive's answer for {entry} makes no sense ({_one_line(error)}); try again") from None
        finally:
            self._asks = False
            self._asking.release()

    def state(self) -> str | None:
        """What the adapter says is wrong with the bus; None when nothing is."""
        bus = self._bus
        try:
            state = bus.state if bus else can.BusState.ACTIVE
        except Exception as error:
            return f"{self.name} cannot be asked for its state ({_one_line(error)}); look at the adapter"
        if state is can.BusState.ACTIVE:
            return None
        return f"{self.name} is {'off' if state is can.BusState.ERROR else 'passive'}; look at cable and termination"

    def received(self, message: can.Message) -> None:
        """One frame, in the receiver's thread."""
        self._receiver = threading.get_ident()
        if message.is_error_frame:
            self.counters["error frames"] += 1
            self._trouble(f"{self.name} reports an error frame; look at cable, termination and bitrate")
        elif message.is_remote_frame or message.is_extended_id:
            self.counters["foreign frames"] += 1
        else:
            self._sort(message.arbitration_id, bytes(message.data))

    def failed(self, error: Exception) -> None:
        """A receiving error, in the receiver's thread."""
        self._receiver = threading.get_ident()
        self.counters["receiving errors"] += 1
        self._trouble(f"{self.name} cannot be read ({_one_line(error)}); look at the adapter and its cable")
        self._clock.sleep(ERROR_PAUSE_S)

    def _receive(self, bus: can.BusABC) -> None:
        """The receiver's thread: nothing that a frame brings can end it."""
        while self._bus is bus:
            try:
                message = bus.recv(RECEIVER_CYCLE_S)
                if message is not None and self._bus is bus:
                    self.received(message)
            except Exception as error:
                if self._bus is bus:
                    self.failed(error)

    def _sort(self, cob_id: int, data: bytes) -> None:
        if cob_id & 0x780 in (objects.SDO_ANSWER, objects.HEARTBEAT) and cob_id & 0x7F:
            self.heard.add(cob_id & 0x7F)
        if cob_id == objects.SDO_ANSWER + self._node:
            if len(data) != 8:
                self.counters["malformed frames"] += 1
            elif self._asks:
                self._sdo.on_response(cob_id, data, 0.0)
        else:
            self._take(cob_id, data)


class _Client(SdoClient):
    """canopen's, whose answers are waited for on our clock."""

    RESPONSE_TIMEOUT = SDO_TIMEOUT_S

    def __init__(self, request: int, answer: int, dictionary: ObjectDictionary, clock: Clock) -> None:
        super().__init__(request, answer, dictionary)  # type: ignore[no-untyped-call]
        self.responses = self._answers = _Answers(clock)

    def request_response(self, sdo_request: bytes | bytearray) -> bytes:
        """Late answers to earlier questions are dropped; where there are any, canopen would put its own queue here."""
        self._answers.clear()
        answer: bytes = super().request_response(sdo_request)  # type: ignore[no-untyped-call]
        return answer


class _Answers(queue.Queue[bytes]):
    """As much of a queue as canopen's client uses."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._news = clock.condition()
        self._waiting: deque[bytes] = deque()

    def put(self, item: bytes, block: bool = True, timeout: float | None = None) -> None:
        with self._news:
            self._waiting.append(item)
            self._news.notify_all()

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        with self._news:
            if not self._news.wait_for(lambda: bool(self._waiting), timeout):
                raise queue.Empty
            return self._waiting.popleft()

    def empty(self) -> bool:
        return not self._waiting

    def clear(self) -> None:
        """Forget what nobody has asked for."""
        self._waiting.clear()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
