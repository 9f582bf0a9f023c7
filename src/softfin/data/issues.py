"""Issues of recordings: severity, place and fix."""

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Most severe first. An error stops training, unless errors are ignored; a note only tells what was
done."""


@dataclasses.dataclass(frozen=True)
class Issue:
    """One thing that is wrong with a log, or that was done to it."""

    severity: Severity
    name: str
    """Kind of issue, such as ``gap``; docs/reference/log-checks.md lists them."""
    log: str
    """Name of the log: its file, and its rows where the file holds several."""
    message: str
    fix: str = ""
    """Fix, usually the option to use."""
    column: str | None = None
    row: int | None = None
    """First row, counted from 0 in the log."""
    logs: tuple[str, ...] = ()
    """All logs that have the issue, once `merge_issues` has joined them."""

    @property
    def place(self) -> str:
        """Log, row and column, as messages name them."""
        place = self.log
        if self.row is not None:
            place += f", row {self.row}"
        if self.column is not None:
            place += f", column {self.column}"
        return place


def counted(number: int, noun: str) -> str:
    """``1 spike``, ``3 spikes``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def merge_issues(issues: Iterable[Issue]) -> list[Issue]:
    """Join issues of one kind and column over all logs, most severe first; the first message is
    kept.

    Notes are joined only if they are equal, because what was done to one log need not hold for
    another.
    """
    kinds: dict[Any, list[Issue]] = {}
    for issue in issues:
        message = issue.message if issue.severity == "note" else ""
        kinds.setdefault((issue.severity, issue.name, issue.column, message), []).append(issue)
    merged = []
    for same in kinds.values():
        names = dict.fromkeys(one.log for one in same)
        merged.append(dataclasses.replace(same[0], logs=tuple(names)))
    return sorted(merged, key=lambda issue: SEVERITIES.index(issue.severity))
