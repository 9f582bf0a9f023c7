"""Progress reports from long computations."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Function that long computations call regularly; the command line shows a progress bar."""

    def __call__(self, stage: str, fraction: float, note: str, /) -> None:
        """Report the completed `fraction` of a stage (0 .. 1) and its latest figures as a
        `note`."""


def silent(stage: str, fraction: float, note: str, /) -> None:
    """Report nothing."""
