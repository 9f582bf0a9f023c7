"""How messages come and go: through rclpy where ROS 2 is installed, else over DDS; the bytes are the same."""

import importlib.util
import os
from typing import NamedTuple, Protocol, runtime_checkable

from pydantic import Field

from softfin.core.choices import TransportName
from softfin.core.configuration import Configuration
from softfin.core.errors import RigError
from softfin.rig.ros2.messages import Messages

DEPTH = 10
"""Messages that are kept for a reader that is slower: ROS 2's default."""


class Received(NamedTuple):
    """A message as it came."""

    data: bytes
    """CDR."""
    time: float
    """When it was taken, of `time.monotonic` [s]."""


@runtime_checkable
class Outlet(Protocol):
    """A topic that we write to."""

    def send(self, data: bytes) -> None:
        """One message as CDR; raises DeviceError where it cannot go out at once."""
        ...

    def listeners(self) -> int:
        """How many read it now."""
        ...


@runtime_checkable
class Inlet(Protocol):
    """A topic that we read."""

    def take(self) -> list[Received]:
        """What has come since the last call, oldest first; never waits."""
        ...


@runtime_checkable
class Transport(Protocol):
    """The way to other nodes."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of how it was opened, each one line."""
        ...

    def publish(self, topic: str, kind: str) -> Outlet:
        """A topic to write to: reliable, keep last 10, volatile."""
        ...

    def subscribe(self, topic: str, kind: str, best_effort: bool = False) -> Inlet:
        """A topic to read: likewise; best effort hears reliable publishers too, but nothing is sent again."""
        ...

    def topics(self) -> dict[str, str]:
        """Topics that somebody else publishes, each with its type."""
        ...

    def close(self) -> None:
        """Leave; any number of times, never raises."""
        ...


class TransportConfig(Configuration):
    """How to reach other nodes."""

    transport: TransportName = "auto"
    """auto: rclpy where it is installed, else DDS."""
    domain: int | None = Field(default=None, ge=0, le=232)
    """ROS domain; None takes the variable ROS_DOMAIN_ID, else 0."""
    network: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_.:-]+$")
    """Network interface that DDS uses, as eth0; None is this computer alone. rclpy takes ROS's own settings."""
    node: str = Field(default="softfin", pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")
    """Name of the node, with rclpy."""

    def domain_id(self) -> int:
        """The domain that counts."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
        if not text.isdecimal() or int(text) > 232:
            raise RigError(f"ROS_DOMAIN_ID={text}: a domain is a whole number from 0 to 232; correct it or unset it")
        return int(text)


def open_transport(config: TransportConfig, messages: Messages) -> Transport:
    """As the configuration asks; raises RigError where what it asks for is not installed."""
    there = importlib.util.find_spec("rclpy") is not None
    if config.transport == "rclpy" and not there:
        raise RigError("rclpy is not installed in this Python; source ROS 2's setup file, or use transport: dds")
    if config.transport == "rclpy" or (config.transport == "auto" and there):
        from softfin.rig.ros2.rclpy import RclpyTransport

        return RclpyTransport(config)
    from softfin.rig.ros2.dds import DdsTransport

    return DdsTransport(config, messages)
