"""A summary and the traces in, a screen of 80 columns and 24 lines out; lines where there is no terminal."""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float64
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from softfin.core.printable import printable
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import MOST, STATES, Summary
from softfin.rig.monitor.trace import Trace

REFRESH_S = 0.25

LINE_S = 5.0
"""Between two lines where there is no terminal [s]."""

SHOWN_S = 20.0
"""Of the traces [s]."""

COLUMNS = 20
"""Of a trace: one a second."""

BLOCKS = "▁▂▃▄▅▆▇█"

LETTERS = "_.-~=+*#"
"""Where a terminal has no blocks."""

COLOURS = {"recording": "bold green", "silent": "bold yellow", "damaged": "bold red"}


def watch(
    follower: Follower, console: Console, *, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None]
) -> None:
    """Until the recording ends, or for ever where a newer one may come."""
    if console.is_terminal:
        _screen(follower, console, sleep)
    else:
        _lines(follower, console, clock, sleep)


def _screen(follower: Follower, console: Console, sleep: Callable[[float], None]) -> None:
    ascii_only = console.options.ascii_only
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while True:
            follower.poll()
            summary = follower.summary()
            live.update(rendered(summary, follower.traces, ascii_only=ascii_only), refresh=True)
            if _over(follower, summary):
                return
            sleep(REFRESH_S)


def _lines(follower: Follower, console: Console, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
    due, said, before = clock(), 0, ""
    while True:
        follower.poll()
        summary = follower.summary()
        over = _over(follower, summary)
        for event in follower.traces["event"].after(said):
            _say(console, f"{event.time:9.2f} s  {event.values[0]}")
            said = event.serial
        if over or clock() >= due:
            # Of a recording that has ended nothing changes any more.
            if (now := line(summary)) != before:
                _say(console, now)
            due, before = clock() + LINE_S, now
        if over:
            return
        sleep(REFRESH_S)


def _say(console: Console, text: str) -> None:
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def _over(follower: Follower, summary: Summary) -> bool:
    return summary.state in ("ended", "damaged") and not follower.follows_folder


def line(summary: Summary) -> str:
    """The recording at one moment, in a line."""
    parts = [
        summary.state if summary.state != "silent" or summary.age_s is None else f"silent ({_ago(summary.age_s)})",
        "" if summary.time_s is None else f"{summary.time_s:.1f} s",
        f"angle {_number(summary.angle_rad)} rad",
        f"force {_vector(summary.force_n)} N",
        f"2 s mean {_vector(summary.mean_force_n)} N",
        f"asked for {_vector(summary.reference_n)} N" if summary.reference_n else "",
        f"current {_number(summary.current_a)} A" if summary.current_a is not None else "",
        _counts(summary),
        summary.problem or "",
    ]
    return ", ".join(filter(None, parts))


def rendered(summary: Summary, traces: Mapping[str, Trace], *, ascii_only: bool = False) -> Group:
    """The screen."""
    parts: list[RenderableType] = [
        _head(summary),
        Text(),
        _table(summary, traces, LETTERS if ascii_only else BLOCKS),
        Text(),
    ]
    parts.append(_line(_counts(summary)))
    if summary.problem:
        parts.append(_line(summary.problem, "red", wrap=True))
    parts.append(Text())
    for event_time, text in summary.events[-6:]:
        parts.append(_line(f"{event_time:9.2f} s  {text}"))
    parts += [] if summary.events else [_line("no events yet", "dim")]
    return Group(*parts)


def _head(summary: Summary) -> Group:
    age = "" if summary.age_s is None or summary.state == "ended" else f"; newest row {_ago(summary.age_s)}"
    at = "" if summary.time_s is None else f", {summary.time_s:.1f} s"
    state = _line(f"{STATES[summary.state]}{at}{age}", COLOURS.get(summary.state, "bold"), wrap=True)
    # The end of a path tells more than its beginning.
    path = summary.path if len(summary.path) <= 79 else "…" + summary.path[-78:]
    return Group(_line(path), state)


def _ago(age_s: float) -> str:
    """Of a clock that may differ from the recorder's."""
    if age_s < -1:
        return f"{-age_s:.0f} s ahead of this computer's clock"
    return f"{max(age_s, 0):.1f} s ago" if age_s < 100 else f"{age_s / 60:,.0f} minutes ago"


def _table(summary: Summary, traces: Mapping[str, Trace], levels: str) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("", no_wrap=True)
    for title in ("now", "2 s mean", "asked for", "least"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column(f"last {SHOWN_S:.0f} s", no_wrap=True)
    table.add_column("most", justify="right", no_wrap=True)
    force, mean, asked = (pair or (None, None) for pair in (summary.force_n, summary.mean_force_n, summary.reference_n))
    rows = [
        ("angle [rad]", summary.angle_rad, None, summary.command_angle_rad, traces["joint"], 1),
        ("velocity [rad/s]", summary.velocity_rad_s, None, None, traces["joint"], 2),
        ("force x [N]", force[0], mean[0], asked[0], traces["wrench"], 1),
        ("force y [N]", force[1], mean[1], asked[1], traces["wrench"], 2),
        ("current [A]", summary.current_a, None, None, traces["current"], 1),
    ]
    for name, now, average, wanted, trace, column in rows:
        table_of = trace.array()
        least, drawn, most = sparkline(table_of[:, 0], table_of[:, column], levels)
        table.add_row(Text(name), _number(now), _number(average), _number(wanted), least, drawn, most)
    return table


def sparkline(
    times: Float64[np.ndarray, " rows"], values: Float64[np.ndarray, " rows"], levels: str
) -> tuple[str, str, str]:
    """Least value, means over equal times as one letter each, most; a space where there is no row."""
    shown = (np.abs(values) < MOST) & (times > (times.max(initial=0.0) - SHOWN_S))
    times, values = times[shown], values[shown]
    if not len(times):
        return "-", " " * COLUMNS, "-"
    low, high = values.min(), values.max()
    start = times.max() - SHOWN_S
    bins = np.clip(((times - start) * COLUMNS / SHOWN_S).astype(int), 0, COLUMNS - 1)
    letters = []
    for k in range(COLUMNS):
        inside = values[bins == k]
        share = 0.0 if high == low else (inside.mean() - low) / (high - low) if len(inside) else 0.0
        letters.append(levels[min(int(share * len(levels)), len(levels) - 1)] if len(inside) else " ")
    return _number(float(low)), "".join(letters), _number(float(high))


def _line(text: str, style: str = "", wrap: bool = False) -> Text:
    return Text(printable(text), style=style, no_wrap=not wrap, overflow="fold" if wrap else "ellipsis")


def _counts(summary: Summary) -> str:
    parts = [f"{summary.rows:,} rows"]
    parts += [] if summary.rate_hz is None else [f"{summary.rate_hz:.1f} Hz"]
    gaps = (("joint", summary.gaps, summary.missing), ("force", summary.force_gaps, summary.force_missing))
    found = ", ".join(f"{name} {count:,} ({rows:,} rows)" for name, count, rows in gaps if count)
    parts.append(f"gaps: {found}" if found else "no gaps")
    parts.append(f"{summary.size_bytes / 1e6:.1f} MB")
    parts += [f"{summary.damaged:,} damaged records"] if summary.damaged else []
    parts += [f"{summary.unreadable:,} unreadable messages"] if summary.unreadable else []
    return ", ".join(parts)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2e}" if abs(value) >= 1e4 else f"{value + 0.0:.2f}".replace("-0.00", "0.00")


def _vector(values: Sequence[float] | None) -> str:
    return "(-, -)" if values is None else f"({_number(values[0])}, {_number(values[1])})"
