"""References while a controller runs: rows of a file, or the newest that a person or a topic has set."""

from bisect import bisect_right
from collections.abc import Callable, Sequence

from softfin.core.errors import SoftfinError
from softfin.rig.loop import Force

ResolveReference = Callable[[Force], tuple[Force, str | None]]
"""A reference to the one that is tracked, and a warning where it is another; raises CoverageError."""


class LiveReference:
    """The newest reference of a person or a topic, set from any thread; one that cannot be tracked changes nothing."""

    def __init__(self, first: Force, resolve: ResolveReference, report: Callable[[str], None]) -> None:
        self._resolve, self._report = resolve, report
        self._force, warning = resolve(first)
        if warning:
            report(warning)

    def __call__(self, at: float) -> Force:
        """Return the newest reference [N]."""
        return self._force

    def set(self, force: Force) -> None:
        """Track this force from now on [N]."""
        try:
            # One assignment of a whole pair: no lock is needed.
            self._force, warning = self._resolve(force)
        except SoftfinError as error:
            warning = f"{error}; the reference stays as it is"
        if warning:
            self._report(warning)

    def set_from_text(self, text: str) -> None:
        """Track the force in a line of the terminal, such as ``2,-1``."""
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            self._report(f"{text!r}: not a reference; write X,Y in newton, as 2,-1; Enter alone stops the fin")
        else:
            self.set((x, y))


class RecordedReference:
    """Rows of a file: each force from its time on; all are resolved before anything moves."""

    def __init__(
        self, time: Sequence[float], force: Sequence[Force], resolve: ResolveReference, report: Callable[[str], None]
    ) -> None:
        self._time = list(time)
        resolved = [resolve(each) for each in force]
        self._force = [tracked for tracked, _ in resolved]
        warnings = [warning for _, warning in resolved if warning is not None]
        if warnings:
            report(warnings[0] + (f" (and {len(warnings) - 1} more rows)" if len(warnings) > 1 else ""))

    def __call__(self, at: float) -> Force:
        """Return the force of the last row whose time has come [N]."""
        return self._force[max(0, bisect_right(self._time, at + 1e-6) - 1)]
