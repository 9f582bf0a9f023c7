"""Progress reports of long work."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Function that long work calls now and then; the command line draws a progress bar with it."""

    def __call__(self, stage: str, fraction: float, note: str, /) -> None:
        """Report the `fraction` of a stage that is done (0 .. 1), and its newest figures as a
        `note`."""


def silent(stage: str, fraction: float, note: str, /) -> None:
    """Report nothing."""
