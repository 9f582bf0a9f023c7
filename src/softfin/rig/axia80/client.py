"""The UDP socket of an Axia80's stream: sends commands, returns the records that have arrived."""

import socket

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError
from softfin.rig.axia80.rdt import RdtCommand, RdtRecord, decode_record, encode_request
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket

BUFFER_BYTES = 4 * 1024 * 1024
"""Size of the kernel's buffer: seconds of the stream, should the process be held up. Linux gives twice
`net.core.rmem_max` at most."""

DATAGRAM_BYTES = 4096


class RdtClient:
    """Never blocks; the socket is connected, so that the kernel passes only what comes from the sensor's port."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self.refused = 0
        self._clock = clock
        self._socket: socket.socket | SimulatedSocket
        if isinstance(clock, SimulatedClock):
            self._socket = SimulatedSocket(clock, host)
            self._socket.connect((host, port))
            return
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.connect((host, port))
            self._socket.setblocking(False)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise DeviceError(
                f"the force sensor at {host}:{port} cannot be reached ({error}); check its address and the network"
            ) from None

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._socket.fileno() == -1

    def send(self, command: RdtCommand) -> bool:
        """Send a command; False where the network does not take it."""
        try:
            self._socket.send(encode_request(command))
        except OSError:
            return False
        return True

    def drain(self) -> tuple[list[RdtRecord], float]:
        """All records that have arrived, and when the last of them did [s]: not earlier, at most a record later."""
        records: list[RdtRecord] = []
        arrived = self._clock()
        while True:
            try:
                if isinstance(self._socket, SimulatedSocket):
                    data, stamp, _ = self._socket.receive()
                else:
                    data, stamp = self._socket.recv(DATAGRAM_BYTES), self._clock()
            except (BlockingIOError, InterruptedError):
                return records, arrived
            except OSError:
                # The answer to an earlier request that found no listener; the silence will tell.
                self.refused += 1
                return records, arrived
            record = decode_record(data)
            if record is None:
                self.refused += 1
            else:
                records.append(record)
                arrived = stamp

    def close(self) -> None:
        """Close the socket; any number of times."""
        self._socket.close()
