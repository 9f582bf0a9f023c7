"""Instructions to one servo and its responses, over a serial port.

The port is half-duplex: an instruction is sent only after the answer to the previous one has
arrived or timed out. Any thread may send; the lock separates instructions.
"""

import contextlib
import struct
from collections import Counter
from collections.abc import Iterator

from softfin.core.errors import DeviceError, one_line
from softfin.rig.computer import Computer, SerialPort
from softfin.rig.device import RefusedError
from softfin.rig.devices.dynamixel.config import DynamixelConfig
from softfin.rig.devices.dynamixel.protocol import (
    ALERT,
    Entry,
    Instruction,
    Packet,
    PacketParser,
    Refusal,
    encode_packet,
)

READ_STEP_S = 0.002
"""Maximum wait of one read [s]."""

WRITE_TIMEOUT_S = 0.05
LINK_TIMEOUT_S = 0.15
"""Maximum wait for an instruction of a different thread [s]; a thread that hangs must not block a
stop."""

SETUP_ANSWER_S = 0.1
"""Maximum wait for an answer outside the loop [s]; writing to the EEPROM takes longer than other
instructions."""


class NoAnswer(DeviceError):
    """The servo did not respond in time."""


class ServoLink:
    """Link to the configured servo."""

    def __init__(self, config: DynamixelConfig, clock: Computer) -> None:
        self.name = f"servo {config.id} on {config.port}"
        self.counters: Counter[str] = Counter()
        self.lock = clock.lock()
        """Held during each instruction; re-entrant, because a signal handler that stops the drive
        may interrupt an instruction."""
        self._config = config
        self._clock = clock
        self._parser = PacketParser()
        self._port: SerialPort | None = None

    def open(self, exclusive: bool = True) -> None:
        """Open the port; raises DeviceError on failure."""
        self.close()
        self.counters.clear()
        self._port = self._clock.open_serial_port(
            self._config.port,
            self._config.baud,
            timeout_s=READ_STEP_S,
            write_timeout_s=WRITE_TIMEOUT_S,
            exclusive=exclusive,
        )
        # Otherwise, FTDI USB adapters such as the U2D2 delay answers by 16 ms. Other ports do not
        # have this setting; `open` of the drive always measures the delay.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._port.set_low_latency_mode(True)

    def close(self) -> None:
        """Close the port; may be called repeatedly and never raises."""
        port = self._port
        self._port = None
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def ping(self) -> tuple[int, int]:
        """Return model number and firmware version; raises DeviceError on failure."""
        data = self._transact(Instruction.PING, b"", 3, SETUP_ANSWER_S, "a ping")
        return int.from_bytes(data[:2], "little"), data[2]

    def read(self, entry: Entry, answer_s: float = SETUP_ANSWER_S) -> int:
        """Read an entry; raises DeviceError on failure."""
        data = self.read_bytes(entry.address, entry.layout.size, answer_s, str(entry))
        return int(entry.layout.unpack(data)[0])

    def write(self, entry: Entry, value: int, answer_s: float = SETUP_ANSWER_S) -> None:
        """Write an entry; raises DeviceError on failure."""
        self.write_bytes(entry.address, entry.layout.pack(value), answer_s, str(entry))

    def read_bytes(self, address: int, size: int, answer_s: float, what: str) -> bytes:
        """Read bytes; on failure, raises DeviceError, which mentions `what`."""
        request = struct.pack("<HH", address, size)
        return self._transact(Instruction.READ, request, size, answer_s, what)

    def write_bytes(self, address: int, data: bytes, answer_s: float, what: str) -> None:
        """Write bytes; on failure, raises DeviceError, which mentions `what`."""
        request = struct.pack("<H", address) + data
        self._transact(Instruction.WRITE, request, 0, answer_s, what)

    def write_unanswered(self, entry: Entry, value: int) -> None:
        """Write an entry without waiting for the answer; raises DeviceError if the port cannot be
        used."""
        request = struct.pack("<H", entry.address) + entry.layout.pack(value)
        with self._using_port() as port:
            port.write(encode_packet(Packet(self._config.id, Instruction.WRITE, request)))

    def reboot(self) -> None:
        """Restart the servo; raises DeviceError on failure."""
        self._transact(Instruction.REBOOT, b"", 0, SETUP_ANSWER_S, "a reboot")

    @contextlib.contextmanager
    def _using_port(self) -> Iterator[SerialPort]:
        """Lock the port for one instruction; raises DeviceError if the port cannot be used."""
        if not self.lock.acquire(timeout=LINK_TIMEOUT_S):
            raise DeviceError(f"{self.name}: an earlier request is still pending; try again")
        try:
            if self._port is None:
                raise DeviceError(f"{self.name}: not open; open it first")
            yield self._port
        except (OSError, TypeError) as error:
            # pyserial raises TypeError if the port is closed in the meantime.
            raise DeviceError(
                f"{self.name}: port cannot be used ({one_line(error)}); check its cable and "
                "adapter, then start again"
            ) from None
        finally:
            self.lock.release()

    def _transact(
        self, instruction: Instruction, request: bytes, size: int, answer_s: float, what: str
    ) -> bytes:
        """Send an instruction and return the data of the answer, which has `size` bytes."""
        with self._using_port() as port:
            # A late answer must not be mistaken for the next answer. If a second program reads it
            # first, an error occurs here, but the instruction must still be sent, because it may be
            # a stop. `reset_input_buffer` raises termios.error, which is not an OSError, at an
            # unplugged port.
            with contextlib.suppress(OSError):
                port.read(port.in_waiting)
            self._parser.clear()
            port.write(encode_packet(Packet(self._config.id, instruction, request)))
            answer = self._await_answer(port, size, self._clock() + answer_s)
        if answer is None:
            self.counters["answers missing"] += 1
            raise NoAnswer(
                f"{self.name}: no response to {what} within {1e3 * answer_s:.0f} ms; check its "
                "supply, cable, ID and baud"
            )
        code = answer[0] & ~ALERT
        if code:
            name = Refusal(code).name.lower().replace("_", " ") if code in set(Refusal) else "?"
            raise RefusedError(
                f"{self.name}: refused {what} (error {code}, {name}); close other programs that "
                "use it, and switch it off and on",
                code,
            )
        return answer[1:]

    def _await_answer(self, port: SerialPort, size: int, end: float) -> bytes | None:
        """Return the error byte and data of the answer; None if no answer arrives in time."""
        while True:
            errors = self._parser.crc_errors
            packets = self._parser.feed(port.read(max(1, port.in_waiting)))
            self.counters["crc errors"] += self._parser.crc_errors - errors
            for packet in packets:
                is_ours = packet.servo_id == self._config.id
                # A refusal has no data. Adapters may echo sent packets, which are not status
                # packets.
                if (
                    is_ours
                    and packet.instruction == Instruction.STATUS
                    and packet.data
                    and (len(packet.data) == 1 + size or packet.data[0] & ~ALERT)
                ):
                    return packet.data
            if self._clock() >= end:
                return None
