"""References while a controller runs: a constant, rows of a file, or the newest that somebody has said."""

import threading
from bisect import bisect_right
from collections.abc import Callable, Sequence

from softfin.core.errors import SoftfinError
from softfin.rig.loop import Force

Admit = Callable[[Force], tuple[Force, str | None]]
"""A reference to the one that is held, and a warning where it is another; raises CoverageError."""


class Said:
    """The newest reference of a person or a topic, set from any thread; one that cannot be held is told, not taken."""

    def __init__(self, first: Force, admit: Admit, tell: Callable[[str], None]) -> None:
        self._admit, self._tell = admit, tell
        self._lock = threading.Lock()
        self._force, warning = admit(first)
        if warning:
            tell(warning)

    def __call__(self, at: float) -> Force:
        """The newest."""
        with self._lock:
            return self._force

    def say(self, force: Force) -> None:
        """From now on."""
        try:
            held, warning = self._admit(force)
        except SoftfinError as error:
            self._tell(f"{error}; the reference stays as it is")
            return
        if warning:
            self._tell(warning)
        with self._lock:
            self._force = held

    def line(self, text: str) -> None:
        """A line of the terminal, as ``2,-1``."""
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            self._tell(f"{text!r}: no reference; write X,Y in newton, as 2,-1; Enter alone stops the fin")
            return
        self.say((x, y))


class Recorded:
    """Rows of a file: each force from its time on; all are admitted before anything moves."""

    def __init__(
        self, time: Sequence[float], force: Sequence[Force], admit: Admit, tell: Callable[[str], None]
    ) -> None:
        self._time = list(time)
        pairs = [admit(each) for each in force]
        self._force = [held for held, _ in pairs]
        warnings = [warning for _, warning in pairs if warning is not None]
        if warnings:
            more = f" (and {len(warnings) - 1} more rows)" if len(warnings) > 1 else ""
            tell(warnings[0] + more)

    def __call__(self, at: float) -> Force:
        """That of the last row that has come [s]."""
        return self._force[max(0, bisect_right(self._time, at + 1e-6) - 1)]
