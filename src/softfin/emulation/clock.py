"""Simulated time, with ports to the emulated devices that run on it."""

import can

from softfin.core.errors import DeviceError
from softfin.emulation.network import SimulatedBus, SimulatedSerialPort, SimulatedSocket
from softfin.emulation.time import SimulatedTime
from softfin.rig.bus import BusConfig
from softfin.rig.computer import Computer, SerialPort, UdpSocket


class SimulatedClock(SimulatedTime, Computer):
    """A computer in simulated time; all connections are within this process, whatever their
    configuration."""

    def open_bus(self, config: BusConfig) -> can.BusABC:
        """Return the bus of a channel."""
        return SimulatedBus(self, config.channel)

    def open_serial_port(
        self, port: str, baud: int, *, timeout_s: float, **options: object
    ) -> SerialPort:
        """Return an end of the serial line with a name; `options` have no effect."""
        return SimulatedSerialPort(self, port, timeout_s)

    def udp_socket(self) -> UdpSocket:
        """Return a new socket."""
        return SimulatedSocket(self)

    def fetch_page(self, host: str, port: int, path: str) -> bytes | None:
        """Return a page of an emulated sensor, or None if it does not exist; raises DeviceError if
        there is no server."""
        pages: dict[str, bytes] | None = self.shared.get(("http", host, port))
        if pages is None:
            raise DeviceError(
                f"http://{host}:{port}{path}: cannot read the web page of the force sensor (no "
                "server); check its power, cable, address and http_port"
            )
        return pages.get(path)
