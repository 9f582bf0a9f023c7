"""Prints the output of commands: results on standard output, progress on standard error."""

import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from softfin.core.printable import printable
from softfin.storage import artifact as artifacts

if TYPE_CHECKING:
    from rich.progress import TaskID

PACE_S = 10.0
"""Interval between progress lines [s]."""


def print_result(result: object, as_json: bool) -> None:
    """Print the result of a command as JSON or text; the items of an iterator are printed as soon
    as they are available."""
    if isinstance(result, Iterator):
        _print_items(result, as_json)
    elif as_json:
        sys.stdout.write(artifacts.dump_json(result))
    elif result is not None:
        _print_text(printable(str(result).rstrip("\n"), "\n"))


def _print_text(text: str) -> None:
    """Print lines, wrapped to the width of a terminal. Lines with a command are not wrapped, so
    that the command can be copied."""
    width = shutil.get_terminal_size().columns
    for line in text.split("\n"):
        shown = line
        if sys.stdout.isatty() and "softfin " not in line:
            shown = textwrap.fill(
                line,
                width,
                subsequent_indent="  ",
                break_long_words=False,
                break_on_hyphens=False,
            )
        sys.stdout.write(f"{shown}\n")


def _print_items(items: Iterator[object], as_json: bool) -> None:
    found: list[object] = []
    try:
        for item in items:
            found.append(item._asdict() if hasattr(item, "_asdict") else item)
            if not as_json:
                _print_text(printable(str(item)))
                sys.stdout.flush()
    finally:
        # This also applies if the last item is followed by an error.
        if as_json:
            sys.stdout.write(artifacts.dump_json(found))


class ProgressLines:
    """Progress lines on standard error: at the start and end of a stage, and at regular intervals
    in between."""

    def __init__(self, now: float) -> None:
        self._lock = threading.Lock()
        self._next_s = now + PACE_S
        self._stage = ""
        self._note = ""
        self._done = 0.0
        self._first = self._last = (now, 0.0)

    def report(self, now: float, stage: str, done: float, note: str) -> None:
        """Record the progress at time `now` [s]; print it if the stage starts or ends."""
        with self._lock:
            begins = stage != self._stage
            ends = done >= 1 > self._done
            if begins:
                self._stage = stage
                self._first = (now, done)
            self._note = note
            self._done = done
            self._last = (now, done)
            if begins or ends:
                self._next_s = now
        self.write(now)

    def write(self, now: float) -> None:
        """Print the progress of the stage if a line is due."""
        with self._lock:
            if now < self._next_s or (self._done >= 1 and now > self._last[0]) or not self._stage:
                return
            self._next_s = now + PACE_S
            left = self._left_s(now)
            line = f"{self._stage}: {self._done:.0%} {printable(self._note)}".rstrip()
            if left:
                line += f" (about {left // 60:.0f}:{left % 60:02.0f} left)"
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()

    def _left_s(self, now: float) -> float | None:
        """Return the estimated remaining time of the stage [s]; None before the second report and
        after the end."""
        (begin, first) = self._first
        (end, last) = self._last
        if last <= first or last >= 1:
            return None
        # At the pace so far: the time per unit of work times the remaining work, minus the time
        # since the last report.
        pace_s = (end - begin) / (last - first)
        return max(float(round(pace_s * (1 - last) - (now - end))), 0.0)


@contextmanager
def progress() -> Iterator[Callable[[str, float, str], None]]:
    """Show progress bars on standard error, or lines if it is not a terminal, with the remaining
    time of each stage."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    console = Console(stderr=True)
    if not console.is_terminal:
        lines = ProgressLines(time.monotonic())
        ended = threading.Event()

        # A stage may report nothing for minutes, so a thread keeps printing.
        def keep_pace() -> None:
            while not ended.wait(PACE_S / 10):
                lines.write(time.monotonic())

        threading.Thread(target=keep_pace, daemon=True).start()
        try:
            yield lambda stage, done, note: lines.report(time.monotonic(), stage, done, note)
        finally:
            ended.set()
        return
    # On a narrow terminal, the bar shrinks first, then the note is truncated.
    bar = Column(min_width=4, ratio=1)
    note = Column(no_wrap=True, overflow="ellipsis")
    columns = (
        TextColumn(
            "{task.description:>12}", markup=False, table_column=Column(no_wrap=True, min_width=12)
        ),
        BarColumn(bar_width=None, table_column=bar),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False, table_column=note),
    )
    with Progress(*columns, console=console, expand=True) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: float, note: str) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0, note="")
            bars.update(tasks[stage], completed=done, note=printable(note))

        yield report
