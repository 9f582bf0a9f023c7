"""Issues found in recordings: severity, place and fix."""

import dataclasses
from collections.abc import Iterable
from typing import Literal

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Severities, most severe first. An error stops training unless errors are ignored; a note only
documents what was done."""


@dataclasses.dataclass(frozen=True)
class Issue:
    """A problem with a log, or a note on a change to the log."""

    severity: Severity
    name: str
    """Kind of issue, such as ``gap``; docs/reference/log-checks.md lists them."""
    log: str
    """Name of the log: the file, and the rows if the file contains several logs."""
    message: str
    fix: str = ""
    """Suggested fix, usually an option."""
    column: str | None = None
    row: int | None = None
    """First affected row, counted from 0 in the log."""
    logs: tuple[str, ...] = ()
    """All logs with this issue, set by `merge_issues`."""

    @property
    def place(self) -> str:
        """Log, row and column, formatted for messages."""
        place = self.log
        if self.row is not None:
            place += f", row {self.row}"
        if self.column is not None:
            place += f", column {self.column}"
        return place


MAX_ODD_SHARE = 0.05
"""Maximum share of rows that may be dropped without an error."""


def row_severity(num_odd: int, num_rows: int) -> Severity:
    """Return the severity of dropped rows; a few dropped rows per recording are normal."""
    return "error" if num_odd > MAX_ODD_SHARE * num_rows else "warning"


def counted(number: int, noun: str) -> str:
    """Return the number with its noun, e.g. ``1 spike`` or ``3 spikes``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def merge_issues(issues: Iterable[Issue]) -> list[Issue]:
    """Merge issues of the same kind and column across logs, most severe first.

    The first message is kept. Notes are merged only if their messages are equal, because logs may
    have been changed differently.
    """
    kinds: dict[tuple[Severity, str, str | None, str], list[Issue]] = {}
    for issue in issues:
        message = issue.message if issue.severity == "note" else ""
        kinds.setdefault((issue.severity, issue.name, issue.column, message), []).append(issue)
    merged = []
    for same in kinds.values():
        names = dict.fromkeys(one.log for one in same)
        merged.append(dataclasses.replace(same[0], logs=tuple(names)))
    return sorted(merged, key=lambda issue: SEVERITIES.index(issue.severity))
