"""The contract of a way to other nodes: messages go out and come in as CDR. rclpy and DDS meet it alike."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

DEPTH = 10
"""Messages that are kept for a reader that is slower: ROS 2's default."""


Take: TypeAlias = Callable[[], list[tuple[bytes, float]]]
"""Returns what has come since the last call, oldest first: CDR, and when it was taken, of `time.monotonic` [s].

It never waits, and raises DeviceError where nothing can come.
"""


@dataclass
class Publisher:
    """A topic that we write to."""

    send: Callable[[bytes], None]
    """Sends one message as CDR; raises DeviceError where it cannot go out at once."""
    readers: Callable[[], int]
    """Number of nodes that read it now."""


@runtime_checkable
class Transport(Protocol):
    """The way to other nodes."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user about how it was opened, each one line."""

    def publish(self, topic: str, kind: str) -> Publisher:
        """A topic to write to: reliable, keep last 10, volatile."""

    def subscribe(self, topic: str, kind: str, best_effort: bool = False) -> Take:
        """A topic to read; best effort matches reliable publishers too, but nothing is sent again."""

    def topics(self) -> dict[str, str]:
        """Topics that other nodes publish, each with its type."""

    def close(self) -> None:
        """Leave; any number of times, never raises."""


def one_line(error: Exception) -> str:
    """The message of an error of any library, in one short line."""
    return " ".join(str(error).split())[:160] or type(error).__name__
