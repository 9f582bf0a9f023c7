"""A recording on the terminal: a screen of 80 columns and 24 lines, or lines where the output is piped."""

import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from jaxtyping import Float64
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from softfin.core.printable import printable
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import LARGEST, STATES, Summary
from softfin.rig.monitor.trace import Trace

REFRESH_S = 0.25

LINE_S = 5.0
"""Time between two lines where the output is piped [s]."""

SHOWN_S = 20.0
"""Time that the traces span [s]."""

COLUMNS = 20
"""Letters of a trace: one a second."""

BLOCKS = "▁▂▃▄▅▆▇█"

LETTERS = "_.-~=+*#"
"""Levels of a trace where a terminal has no blocks."""

COLOURS = {"recording": "bold green", "silent": "bold yellow", "damaged": "bold red"}


def watch(
    follower: Follower, console: Console, *, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None]
) -> None:
    """Show a recording until it ends, or for ever where a newer one may come."""
    if console.is_terminal:
        with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
            for summary, _ in _looks(follower, sleep):
                screen = render(summary, follower.traces, ascii_only=console.options.ascii_only)
                live.update(screen, refresh=True)
        return

    def say(text: str) -> None:
        console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    due, last_serial, before = clock(), 0, ""
    for summary, is_over in _looks(follower, sleep):
        for event in follower.traces["event"].after(last_serial):
            say(f"{event.time:9.2f} s  {event.values[0]}")
            last_serial = event.serial
        if is_over or clock() >= due:
            # Of a recording that has ended nothing changes any more.
            if (now := _describe(summary)) != before:
                say(now)
            due, before = clock() + LINE_S, now


def _looks(follower: Follower, sleep: Callable[[float], None]) -> Iterator[tuple[Summary, bool]]:
    """Yield a summary after each look, and whether it is the last one."""
    is_over = False
    while not is_over:
        follower.poll()
        summary = follower.summary()
        is_over = summary.state in ("ended", "damaged") and not follower.follows_folder
        yield summary, is_over
        if not is_over:
            sleep(REFRESH_S)


def _describe(summary: Summary) -> str:
    """Describe the recording at one moment, in a line."""
    parts = [
        summary.state if summary.state != "silent" or summary.age_s is None else f"silent ({_ago(summary.age_s)})",
        "" if summary.time_s is None else f"{summary.time_s:.1f} s",
        f"angle {_number(summary.angle_rad)} rad",
        f"force {_vector(summary.force_n)} N",
        f"2 s mean {_vector(summary.mean_force_n)} N",
        f"asked for {_vector(summary.reference_n)} N" if summary.reference_n else "",
        f"current {_number(summary.current_a)} A" if summary.current_a is not None else "",
        summary.counts(),
        summary.problem or "",
    ]
    return ", ".join(filter(None, parts))


def render(summary: Summary, traces: Mapping[str, Trace], *, ascii_only: bool = False) -> Group:
    """Draw the screen."""
    age = "" if summary.age_s is None or summary.state == "ended" else f"; newest row {_ago(summary.age_s)}"
    at = "" if summary.time_s is None else f", {summary.time_s:.1f} s"
    events = [_line(f"{event_time:9.2f} s  {text}") for event_time, text in summary.events[-6:]]
    return Group(
        # The end of a path says more than its beginning.
        _line(summary.path if len(summary.path) <= 79 else "…" + summary.path[-78:]),
        _line(f"{STATES[summary.state]}{at}{age}", COLOURS.get(summary.state, "bold"), wrap=True),
        Text(),
        _table(summary, traces, LETTERS if ascii_only else BLOCKS),
        Text(),
        _line(summary.counts()),
        *([_line(summary.problem, "red", wrap=True)] if summary.problem else []),
        Text(),
        *(events or [_line("no events yet", "dim")]),
    )


def _ago(age_s: float) -> str:
    """Describe an age by a clock that may differ from the recorder's."""
    if age_s < -1:
        return f"{-age_s:.0f} s ahead of this computer's clock"
    return f"{max(age_s, 0):.1f} s ago" if age_s < 100 else f"{age_s / 60:,.0f} minutes ago"


def _table(summary: Summary, traces: Mapping[str, Trace], levels: str) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    last = f"last {SHOWN_S:.0f} s"
    for title in ("", "now", "2 s mean", "asked for", "least", last, "most"):
        table.add_column(title, justify="left" if title in ("", last) else "right", no_wrap=True)
    force, mean, asked = (pair or (None, None) for pair in (summary.force_n, summary.mean_force_n, summary.reference_n))
    rows = [
        ("angle [rad]", summary.angle_rad, None, summary.command_angle_rad, traces["joint"], 1),
        ("velocity [rad/s]", summary.velocity_rad_s, None, None, traces["joint"], 2),
        ("force x [N]", force[0], mean[0], asked[0], traces["wrench"], 1),
        ("force y [N]", force[1], mean[1], asked[1], traces["wrench"], 2),
        ("current [A]", summary.current_a, None, None, traces["current"], 1),
    ]
    for name, now, average, wanted, trace, column in rows:
        values = trace.array()
        line = sparkline(values[:, 0], values[:, column], levels)
        table.add_row(Text(name), _number(now), _number(average), _number(wanted), *line)
    return table


def sparkline(
    times: Float64[np.ndarray, " rows"], values: Float64[np.ndarray, " rows"], levels: str
) -> tuple[str, str, str]:
    """Return least value, means over equal times as one letter each, most; a space where rows are missing."""
    shown = (np.abs(values) < LARGEST) & (times > (times.max(initial=0.0) - SHOWN_S))
    times, values = times[shown], values[shown]
    if not len(times):
        return "-", " " * COLUMNS, "-"
    low, high = float(values.min()), float(values.max())
    bins = np.clip(((times - times.max() + SHOWN_S) * COLUMNS / SHOWN_S).astype(int), 0, COLUMNS - 1)
    counts = np.bincount(bins, minlength=COLUMNS)
    means = np.bincount(bins, values, COLUMNS) / np.maximum(counts, 1)
    heights = np.zeros(COLUMNS) if high == low else (means - low) / (high - low)
    indices = np.clip((heights * len(levels)).astype(int), 0, len(levels) - 1)
    letters = (levels[index] if count else " " for index, count in zip(indices, counts, strict=True))
    return _number(low), "".join(letters), _number(high)


def _line(text: str, style: str = "", wrap: bool = False) -> Text:
    return Text(printable(text), style=style, no_wrap=not wrap, overflow="fold" if wrap else "ellipsis")


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2e}" if abs(value) >= 1e4 else f"{value + 0.0:.2f}".replace("-0.00", "0.00")


def _vector(values: tuple[float, float] | None) -> str:
    return "(-, -)" if values is None else f"({_number(values[0])}, {_number(values[1])})"
