"""What is wrong with recordings, in words with numbers: each finding says how grave it is, where, and the way out."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

from softfin.core.errors import LogError

Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Gravest first. An error stops training, unless accepted; a warning is worth a look; a note says what was done."""


class Place(NamedTuple):
    """What a finding is about."""

    log: str
    """The log's name: its file, and its rows where the file holds several."""
    column: str | None = None
    row: int | None = None
    """Counted from 0, in the log."""

    def __str__(self) -> str:
        parts = [self.log, *([] if self.row is None else [f"row {self.row}"])]
        return ", ".join([*parts, *([] if self.column is None else [f"column {self.column}"])])


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or that was done."""

    severity: Severity
    name: str
    """Of the kind of finding, such as ``gap``: docs/logs.md has them all."""
    place: Place
    sentence: str
    remedy: str = ""
    """The way out: as a rule the very option."""
    logs: tuple[str, ...] = ()
    """All logs that it was found in, once `merged`."""
    alike: str = ""
    """Findings of a kind that differ in this are not merged: what the first one says does not hold for the others."""

    def described(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "severity": self.severity,
            "name": self.name,
            **self.place._asdict(),
            "finding": self.sentence,
            "remedy": self.remedy,
            "logs": list(self.logs) or [self.place.log],
        }


def counted(number: int, noun: str) -> str:
    """``1 spike``, ``3 spikes``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def merged(findings: Iterable[Finding]) -> list[Finding]:
    """One finding for all that are of a kind and a column and alike, gravest first; the first speaks for the others."""
    kinds: dict[Any, list[Finding]] = {}
    for finding in findings:
        kinds.setdefault((finding.severity, finding.name, finding.place.column, finding.alike), []).append(finding)
    alike = [
        dataclasses.replace(
            group[0], logs=tuple(dict.fromkeys(log for one in group for log in one.logs or (one.place.log,)))
        )
        for group in kinds.values()
    ]
    return sorted(alike, key=lambda finding: SEVERITIES.index(finding.severity))


def check_accepted(findings: Sequence[Finding], source: str, accept: bool = False) -> None:
    """Raise LogError with the first finding that stops training, and the count of the others, unless accepted."""
    errors = [finding for finding in findings if finding.severity == "error"]
    if not errors or accept:
        return
    first = errors[0]
    others = "" if len(errors) == 1 else f"; and {len(errors) - 1} more: softfin inspect tells them"
    remedy = f"; {first.remedy}" if first.remedy else ""
    raise LogError(
        f"{source}: {first.place}: {first.sentence}{remedy}{others}; --accept takes these logs in spite of it"
    )
