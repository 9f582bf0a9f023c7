"""A recording on the terminal: a screen of 80 columns and 24 lines; its last state where the output is piped."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float64
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from softfin.core.printable import printable
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import LARGEST, STATES, Summary, Trace

REFRESH_S = 0.25

SHOWN_S = 20.0
"""Time that the traces span [s]."""

COLUMNS = 20
"""Letters of a trace: one a second."""

BLOCKS = "▁▂▃▄▅▆▇█"

LETTERS = "_.-~=+*#"
"""Levels of a trace where a terminal has no blocks."""

COLOURS = {"recording": "bold green", "silent": "bold yellow", "damaged": "bold red"}


def watch(follower: Follower, console: Console, *, sleep: Callable[[float], None]) -> None:
    """Show a recording until it ends, or for ever where a newer one may come."""
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while True:
            follower.poll()
            summary = follower.summary()
            screen = render(summary, follower.traces, ascii_only=console.options.ascii_only)
            live.update(screen, refresh=True)
            if summary.state in ("ended", "damaged") and not follower.follows_folder:
                return
            sleep(REFRESH_S)


def render(summary: Summary, traces: Mapping[str, Trace], ascii_only: bool = False) -> Group:
    """Return the whole screen."""
    age = f", newest {_ago(summary.age_s)}" if summary.state == "silent" and summary.age_s is not None else ""
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
    for name, *numbers, trace, column in rows:
        values = trace.array()
        table.add_row(Text(name), *map(_number, numbers), *sparkline(values[:, 0], values[:, column], levels))
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
