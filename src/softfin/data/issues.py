"""What is wrong with recordings: how grave it is, where it is, and what to do about it."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal

from softfin.core.errors import LogError

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Gravest first. An error stops training, unless errors are ignored; a note only tells what was done."""


@dataclasses.dataclass(frozen=True)
class Issue:
    """One thing that is wrong with a log, or that was done to it."""

    severity: Severity
    name: str
    """Kind of issue, such as ``gap``; docs/logs.md lists them."""
    log: str
    """Name of the log: its file, and its rows where the file holds several."""
    message: str
    fix: str = ""
    """What to do, as a rule the very option."""
    column: str | None = None
    row: int | None = None
    """First row, counted from 0 in the log."""
    logs: tuple[str, ...] = ()
    """All logs that have the issue, once `merge_issues` has joined them."""
    group: str = ""
    """Issues that differ in this are not merged, because the message of one does not hold for the other."""

    @property
    def place(self) -> str:
        """Log, row and column as a message names them."""
        row = [] if self.row is None else [f"row {self.row}"]
        return ", ".join([self.log, *row, *([] if self.column is None else [f"column {self.column}"])])

    def to_dict(self) -> dict[str, Any]:
        """The issue for JSON."""
        names = ("severity", "name", "log", "column", "row", "message", "fix")
        return {name: getattr(self, name) for name in names} | {"logs": list(self.logs) or [self.log]}


def counted(number: int, noun: str) -> str:
    """``1 spike``, ``3 spikes``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def merge_issues(issues: Iterable[Issue]) -> list[Issue]:
    """Join issues of one kind, column and group over all logs, gravest first; the first one's message stands."""
    kinds: dict[Any, list[Issue]] = {}
    for issue in issues:
        kinds.setdefault((issue.severity, issue.name, issue.column, issue.group), []).append(issue)
    merged = [
        dataclasses.replace(same[0], logs=tuple(dict.fromkeys(log for one in same for log in one.logs or (one.log,))))
        for same in kinds.values()
    ]
    return sorted(merged, key=lambda issue: SEVERITIES.index(issue.severity))


def check_issues(issues: Sequence[Issue], source: str, ignore_errors: bool = False) -> None:
    """Raise LogError with the first error and the count of the others, unless errors are ignored."""
    errors = [issue for issue in issues if issue.severity == "error"]
    if not errors or ignore_errors:
        return
    first = errors[0]
    others = "" if len(errors) == 1 else f"; and {len(errors) - 1} more: softfin inspect lists them"
    fix = f"; {first.fix}" if first.fix else ""
    raise LogError(
        f"{source}: {first.place}: {first.message}{fix}{others}; --ignore-errors takes these logs in spite of it"
    )
