"""The computer that runs the drivers: its clock and the ports of its devices.

Emulated devices in simulated time use the ports of a different computer,
`softfin.emulation.clock.SimulatedClock`.
"""

import socket
from typing import TYPE_CHECKING, Protocol, cast

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError, one_line
from softfin.rig.bus import BusConfig
from softfin.rig.web_page import fetch_page

if TYPE_CHECKING:
    import can

Address = tuple[str, int]
"""Host and port."""


class UdpSocket(Protocol):
    """The methods of a UDP socket that softfin uses."""

    def bind(self, address: Address, /) -> None:
        """Set the local address of the socket."""

    def connect(self, address: Address, /) -> None:
        """Set the only remote address."""

    def setsockopt(self, level: int, option: int, value: int, /) -> None:
        """Set an option."""

    def settimeout(self, seconds: float | None, /) -> None:
        """Set the maximum wait for a datagram [s]; 0 for no wait."""

    def send(self, data: bytes, /) -> int:
        """Send to the connected address."""

    def sendto(self, data: bytes, address: Address, /) -> int:
        """Send to an address."""

    def recvfrom(self, size: int, /) -> tuple[bytes, Address]:
        """Return a datagram and its sender."""

    def recvmsg(
        self, size: int, ancillary: int, /
    ) -> tuple[bytes, list[tuple[int, int, bytes]], int, Address]:
        """Return a datagram, the ancillary data from the kernel, flags, and the sender."""

    def getsockname(self) -> Address:
        """Return the local address of the socket."""

    def fileno(self) -> int:
        """Return -1 if the socket is closed."""

    def close(self) -> None:
        """Close; may be called repeatedly."""


class SerialPort(Protocol):
    """The members of a pyserial port that softfin uses."""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have arrived."""

    def read(self, size: int, /) -> bytes:
        """Return `size` bytes, or fewer if the port times out."""

    def write(self, data: bytes, /) -> object:
        """Send bytes."""

    def set_low_latency_mode(self, is_low: bool, /) -> None:
        """Configure the adapter to pass on bytes immediately; raises an error if this is not
        supported."""

    def close(self) -> None:
        """Close; may be called repeatedly."""


class Computer(Clock):
    """The clock and the ports of the computer."""

    def open_bus(self, config: BusConfig) -> "can.BusABC":
        """Open a CAN bus; raises python-can's errors."""
        # Imported here because only drives on a bus need it.
        import can

        settings = config.model_dump()
        return can.Bus(**settings.pop("options"), **settings)

    def open_serial_port(
        self,
        port: str,
        baud: int,
        *,
        timeout_s: float,
        write_timeout_s: float | None = None,
        exclusive: bool = True,
    ) -> SerialPort:
        """Open a serial port; raises DeviceError on failure.

        Reading waits for up to `timeout_s`, and writing for up to `write_timeout_s` (None: no
        limit). With `exclusive`, no other program may use the port.
        """
        # Imported here because it belongs to the `serial` extra, which not every rig needs.
        import serial

        try:
            return cast(
                SerialPort,
                serial.Serial(
                    port,
                    baud,
                    timeout=timeout_s,
                    write_timeout=write_timeout_s,
                    exclusive=exclusive,
                ),
            )
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"serial port {port}: cannot be opened ({one_line(error)}); check the cable, port "
                "and your permission to use it, and close other programs that use it"
            ) from None

    def udp_socket(self) -> UdpSocket:
        """Return a new UDP socket."""
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def fetch_page(self, host: str, port: int, path: str) -> bytes | None:
        """Return a web page of a device; None if the device does not have this page."""
        return fetch_page(host, port, path)


COMPUTER = Computer()
"""The computer of every real rig."""
