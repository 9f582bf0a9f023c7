"""Configuration of the CAN bus in a rig file."""

from pydantic import Field

from softfin.core.configuration import Configuration


class BusConfig(Configuration):
    """A CAN bus, as defined by python-can."""

    interface: str
    """python-can interface of the adapter, e.g. socketcan, pcan, kvaser, slcan, socketcand or
    virtual; no default."""
    channel: str
    """Channel of the interface, e.g. can0; no default."""
    bitrate: int = Field(1_000_000, gt=0, le=1_000_000)
    """Bitrate [bit/s]; the factory setting of an EPOS2 is 1 Mbit/s. SocketCAN uses the bitrate set
    with ``ip link``."""
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)
    """Additional options for the interface, such as host and port for socketcand."""
